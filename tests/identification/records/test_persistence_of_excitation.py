"""Test persistence of excitation: insufficient excitation is rejected with a remedy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt

from levid.identification.identify import identify
from levid.identification.records.persistence_of_excitation import (
    PoorExcitationError,
    check_excitation,
    repetition,
)
from levid.identification.records.record import PiController, Record

ROWS, LENGTH = 20_000, 2000
NAMES = ("psi", "theta", "z")


def _records(signals: list[np.ndarray]) -> list[Record]:
    """Return one record for each signal, which excites one input, with different magnitudes."""
    records = []
    for axis, signal in enumerate(signals):
        v = np.zeros((len(signal), 3))
        v[:, axis] = 10.0**axis * signal
        y = 1e-3 * np.random.default_rng(axis).normal(size=v.shape)
        records.append(
            Record(
                f"r{axis}", 1e-3, v, y, NAMES, ("1",) * 3, NAMES, ("1",) * 3, u=v, beam_m=0.0,
                controller=PiController(np.ones(3), np.ones(3)), delay_cycles=1,
            )
        )  # fmt: skip
    return records


def _noise(seed: int, rows: int = ROWS) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=rows)


def _multisine(period: int, lines: np.ndarray, rows: int = ROWS) -> np.ndarray:
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, len(lines))
    one = np.cos(2 * np.pi * np.outer(np.arange(period), lines) / period + phase).sum(axis=1)
    return np.resize(one, rows)


@pytest.mark.parametrize("rows", [ROWS, 6000])
def test_white_and_moderately_coloured_noise_are_accepted(rows):
    check_excitation(_records([_noise(a, rows) for a in range(3)]), LENGTH)
    # Power falls by (1.9 / 0.1)^2 = 26 dB: inaccurate at the top of the band, but identifiable.
    coloured = [lfilter([1.0], [1.0, -0.9], _noise(a, rows)) for a in range(3)]
    check_excitation(_records(coloured), LENGTH)


@pytest.mark.parametrize(
    ("band_hz", "covered"), [((1, 100), r"\d\.\d+ to 1\d\d Hz"), ((0.1, 400), r"to 4\d\d Hz")]
)
def test_error_names_the_covered_band_and_the_remedy(band_hz, covered):
    sos = butter(8, band_hz, "bandpass", fs=1000.0, output="sos")
    records = _records([sosfilt(sos, _noise(a)) for a in range(3)])
    with pytest.raises(PoorExcitationError, match=f"{covered} covered.*white noise.*orthogonal"):
        check_excitation(records, LENGTH)


def test_records_of_one_position_cover_the_band_together():
    sos = butter(8, 100, "lowpass", fs=1000.0, output="sos")
    poor = _records([sosfilt(sos, _noise(a)) for a in range(3)])
    rich = _records([_noise(a) for a in range(3)])
    check_excitation([*poor, *rich], LENGTH)


def test_correlated_inputs_are_rejected():
    (record, *_) = _records([_noise(0)])
    v = np.repeat(record.v[:, :1], 3, axis=1)
    same = Record(**{**record.__dict__, "v": v})
    with pytest.raises(PoorExcitationError, match="fully correlated inputs"):
        check_excitation([same], LENGTH)


def test_multisine_with_a_period_below_the_impulse_response_is_rejected():
    lines = np.arange(1, 700)
    records = _records([_multisine(1500, lines)])
    assert repetition(records, LENGTH) == pytest.approx(1500, abs=1)
    assert repetition(records, 1000) is None
    # With odd lines only, the signal changes sign after half a period.
    assert repetition(_records([_multisine(1500, lines[::2])]), 1000) == pytest.approx(750, abs=1)
    assert repetition(_records([_noise(0)]), LENGTH) is None
    with pytest.raises(PoorExcitationError, match=r"a period of 1\.5 s"):
        check_excitation(records, LENGTH)


def test_position_without_enough_inputs_does_not_fail_the_others(rig):
    records = rig.records([0.0], 1000.0, 20.0)
    lacking = [replace(r, beam_m=0.1) for r in records[:2]]
    short = [replace(r, beam_m=-0.1).rows(0, 12) for r in records]
    result = identify([*records, *lacking, *short])
    assert [p.beam_m for p in result.points] == [0.0]
    assert [reason.partition(": ")[0] for reason in result.skipped] == [
        "beam at -100.0 mm",
        "beam at +100.0 mm",
    ]
    assert "no excitation of z in" in result.skipped[1]
    with pytest.raises(PoorExcitationError, match="no excitation of z in"):
        identify(lacking)


def test_poorly_excited_position_does_not_fail_the_others(rig):
    records = rig.records([0.0], 1000.0, 20.0)
    sos = butter(8, 100, "lowpass", fs=1000.0, output="sos")
    poor = [
        Record(**{**r.__dict__, "v": sosfilt(sos, r.v, axis=0), "beam_m": 0.1}) for r in records
    ]
    result = identify([*records, *poor])
    assert [p.beam_m for p in result.points] == [0.0]
    (reason,) = result.skipped
    assert reason.startswith("beam at +100.0 mm: Markov parameters: expected")
    with pytest.raises(PoorExcitationError, match=r"beam at \+100\.0 mm"):
        identify(poor)
