"""Test the scores of support against truth, for statements whose scores are known."""

from __future__ import annotations

import numpy as np
import pytest

from levid.benchmarks.trace.support_calibration import (
    Statement,
    brier,
    figures,
    log_score,
    reliability,
    statements,
)


def test_every_member_of_an_ambiguous_effect_is_a_statement() -> None:
    members = [
        {"class": "payload", "where": ["z"], "support": 0.3},
        {"class": "sensor_scale", "where": ["sensor:0"], "support": 0.6},
    ]
    summary = {
        "effects": [
            {"class": "ambiguous", "where": ["z"], "support": 0.9, "alternatives": members},
            {"class": "friction", "where": ["z"], "support": 1.0, "alternatives": []},
            {"class": "unknown", "where": ["z"], "support": 1.0, "alternatives": []},
            {"class": "vibration", "where": ["z"]},
        ]
    }
    told = statements(summary, lambda one: one["class"] in {"sensor_scale", "friction"})
    assert told == [Statement(0.3, False), Statement(0.6, True), Statement(1.0, True)]


def test_scores_of_known_statements() -> None:
    told = [Statement(0.5, True), Statement(0.5, False)]
    assert brier(told) == pytest.approx(0.25)
    assert log_score(told) == pytest.approx(np.log(2.0))
    assert brier([Statement(1.0, True)]) == 0.0
    assert log_score([Statement(1.0, False)]) == pytest.approx(-np.log(0.005))  # not infinite


def test_calibrated_support_is_on_the_diagonal() -> None:
    rng = np.random.default_rng(1)
    supports = rng.uniform(size=20_000)
    told = [Statement(float(p), bool(rng.uniform() < p)) for p in supports]
    for low, high, count, mean, share in reliability(told):
        assert low <= mean <= high
        # Four standard deviations of a binomial share.
        assert share == pytest.approx(mean, abs=4.0 * np.sqrt(0.25 / count))
    # A calibrated support that is uniform has the expected score of p (1 - p).
    assert brier(told) == pytest.approx(1.0 / 6.0, abs=0.005)
    assert sum(row[2] for row in reliability(told)) == len(told)


def test_without_statements_there_are_no_figures() -> None:
    assert list(figures([])) == []
    keys = [f.key for f in figures([Statement(1.0, True)])]
    assert keys == ["statements", "brier", "log_score", "true_percent_95_100"]
