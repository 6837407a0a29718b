"""Test fits with instruments where a random force biases least squares, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from levid.benchmarks.trace.judged_plants import RECORDS
from levid.benchmarks.trace.random_forces_in_loops import TS_S, Axis, declared
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_checks import instrumental_variables
from levid.identification.trace.force_checks.instrumental_variables import projected
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record

SEED = 93_000
NAMES = ("m1", "d1", "k1")


def axis(random: float) -> tuple[Axis, ModelConfig]:
    rng = np.random.default_rng(SEED)
    drawn = replace(Axis.drawn("nothing missing", rng), random=random)
    return drawn, declared(drawn, rng)


def open_loop(random: float) -> ForceTrace:
    drawn, config = axis(random)
    flown = [drawn.flown(RECORDS * SEED + i, looped=False) for i in range(RECORDS)]
    return fitted(
        config, [Experiment("r", TS_S, u, y, {}, frozenset(), False) for u, y, _ in flown]
    )


def in_a_loop(random: float) -> ForceTrace:
    drawn, config = axis(random)
    flown = [drawn.flown(RECORDS * SEED + i) for i in range(RECORDS)]
    none = {}, frozenset[str](), False
    return fitted(
        config,
        [
            Experiment("r", TS_S, u, y, *none, feedback=True, commanded=wanted)
            for u, y, wanted in flown
        ],
    )


def fitted(config: ModelConfig, experiments: list[Experiment]) -> ForceTrace:
    """Return the trace with an empty table: a fit of the declared model."""
    records = [imported_trace_record(e, config) for e in experiments]
    return trace_records(records, config, lambda *_: (), lambda *_: None)


def deviations(trace: ForceTrace) -> list[float]:
    """Return how far the parameters are from the truth, in standard errors."""
    drawn, _ = axis(0.0)
    pairs = zip(trace.found.point.values, NAMES, trace.errors, strict=True)
    return [abs(value - getattr(drawn, name)) / se for value, name, se in pairs]


def least_squares(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(instrumental_variables, "projected", lambda records: None)


@pytest.mark.parametrize("flown", [open_loop, in_a_loop])
def test_numbers_are_not_biased_by_a_random_force(flown, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    assert max(deviations(flown(0.3))) < 3.0
    least_squares(monkeypatch)
    assert max(deviations(flown(0.3))) > 3.0


def test_without_a_random_force_least_squares_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    both = open_loop(0.0)
    least_squares(monkeypatch)
    alone = open_loop(0.0)
    np.testing.assert_array_equal(both.found.point.values, alone.found.point.values)
    np.testing.assert_array_equal(both.errors, alone.errors)


def test_a_projection_has_nothing_of_its_own_record_s_random_force() -> None:
    # Records with the same commands, and another random force in the first one.
    drawn, config = axis(0.3)
    (u, y, _), (_, other, _) = (a.flown(SEED, looped=False) for a in (drawn, axis(0.2)[0]))
    more, seen, _ = drawn.flown(SEED + 1, looped=False)

    def first(reading: np.ndarray) -> np.ndarray:
        records = [(u, reading), (more, seen)]
        experiments = [Experiment("r", TS_S, *r, {}, frozenset(), False) for r in records]
        found = projected([imported_trace_record(e, config) for e in experiments])
        assert found is not None
        return found[0].experiment.y

    moved = first(other) - first(y)
    # What is left is the mean, which every fit is free of.
    np.testing.assert_allclose(moved, moved.mean(), atol=1e-12)
    assert np.std(other - y) > 0.05 * np.std(y)
    assert np.std(first(y) - y) < 0.9 * np.std(y)


def test_a_loop_without_recorded_causes_has_no_instruments() -> None:
    drawn, config = axis(0.3)
    u, y, points = drawn.flown(SEED)
    record = Experiment("r", TS_S, u, y, {}, frozenset(), False, feedback=True)
    for commanded in (None, np.full_like(points, 3.0)):
        looped = imported_trace_record(replace(record, commanded=commanded), config)
        assert projected([looped]) is None
    looped = imported_trace_record(replace(record, commanded=points), config)
    assert projected([looped]) is not None
