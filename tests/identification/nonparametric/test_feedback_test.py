"""Test whether outputs drive inputs, and whether anything else does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from levid.benchmarks.harness.loops_under_noise import Loop, multisine, steps
from levid.identification.nonparametric.feedback_test import feedback_findings, input_origins
from levid.identification.records.record import Record

ROWS = 1500
LOOPS = {
    "PI": Loop(),
    "P": Loop(ki=0.0),
    "PD": Loop(ki=0.0, kd=1.0),
    "PID, delay": Loop(kp=10.0, ki=10.0, kd=0.3, delay=3),
    "weak": Loop(kp=3.0, ki=5.0),
    "noise of the sensor alone": Loop(force=0.0, sensor=1e-3, kd=0.2),
    "input measured with noise": Loop(input=0.01, sensor=3e-3),
    "at 1 kHz": Loop(Ts_s=1e-3),
}


def white(seed: int, rows: int = ROWS) -> np.ndarray:
    return np.random.default_rng(1000 + seed).normal(size=rows)


GIVEN = {
    "white": white,
    "coloured": lambda seed: lfilter([0.05], [1.0, -0.95], white(seed)),
    "multisine": lambda seed: multisine(ROWS, 60, seed),
    "periodic": lambda seed: np.tile(multisine(250, 20, seed), 6),
    "steps": lambda seed: steps(ROWS, 100, seed),
    "one step": lambda _seed: (np.arange(ROWS) > 300).astype(float),
    "sine": lambda _seed: np.sin(0.07 * np.arange(ROWS)),
}


@pytest.mark.parametrize("name", LOOPS)
def test_loop_that_only_noise_excites_is_found(name: str) -> None:
    loop = LOOPS[name]
    rows = round(15.0 / 0.01) if loop.Ts_s == 0.01 else 4000  # several periods of the mode, 0.9 s
    for declared in (False, True):
        (origin,) = input_origins([loop.record(rows, 1, feedback=declared)])
        assert origin.unexcited, origin


@pytest.mark.parametrize("sensor", [0.0, 1e-4, 3e-3])
@pytest.mark.parametrize("name", GIVEN)
def test_open_loop_is_not_taken_for_a_loop(name: str, sensor: float) -> None:
    # 63 records with a chance of 1e-6 each.
    for seed in range(3):
        given = GIVEN[name](seed)
        for force in (0.0, 0.3) if sensor else (0.0,):
            record = Loop(sensor=sensor, force=force).record(ROWS, seed, given=given)
            assert not any(o.fed_back for o in input_origins([record]))


def test_output_that_answers_in_the_row_of_its_input_is_not_taken_for_a_loop() -> None:
    u = lfilter([0.05], [1.0, -0.95], white(1))
    for noise in (0.0, 1e-3):  # an accelerometer on a mass, or a lever
        y = 2.0 * u + noise * white(2)
        record = replace(Loop().record(ROWS, 1), v=u[:, None], y=y[:, None])
        assert not any(o.fed_back for o in input_origins([record]))


@pytest.mark.parametrize(
    "excitation", [2.0 * white(1), multisine(ROWS, 60, 1), 2.0 * steps(ROWS, 100, 1)]
)
def test_excited_loop_is_not_called_unexcited(excitation: np.ndarray) -> None:
    for loop in LOOPS.values():
        record = loop.record(ROWS, 2, excitation=excitation, feedback=True)
        assert not any(o.unexcited for o in input_origins([record]))


def test_each_input_is_judged_by_itself() -> None:
    # Two plants side by side: the first in a loop without excitation, the second in open loop.
    loop, free = Loop().record(ROWS, 1), Loop().record(ROWS, 2, given=white(2))
    both = Record(
        "r", 0.01, np.hstack([loop.v, free.v]), np.hstack([loop.y, free.y]),
        ("a", "b"), ("N", "N"), ("x", "y"), ("m", "m"),
    )  # fmt: skip
    first, second = input_origins([both])
    assert first.fed_back
    assert first.from_noise > 0.9
    assert not second.fed_back


def test_units_and_levels_do_not_matter() -> None:
    record = Loop().record(ROWS, 1)
    (plain,) = input_origins([record])
    (scaled,) = input_origins([replace(record, v=1e9 * record.v + 1e9, y=1e-9 * record.y)])
    assert scaled.from_noise == pytest.approx(plain.from_noise, rel=1e-3)


@pytest.mark.parametrize("rows", [1, 20, 50])
def test_short_records_are_no_evidence(rows: int) -> None:
    found = input_origins([Loop().record(ROWS, 1).rows(0, rows)])
    assert all(o.chance <= 1.0 for o in found)


def test_constant_signals_are_no_evidence() -> None:
    record = Loop().record(ROWS, 1)
    assert input_origins([replace(record, v=0.0 * record.v)]) == ()
    assert input_origins([replace(record, y=0.0 * record.y + 3.0)]) == ()


def test_doubt_says_what_fits_and_what_to_fly() -> None:
    found = feedback_findings(input_origins([Loop().record(ROWS, 1)]), declared=False)
    (doubt,) = found.doubts
    for text in ("minus the inverse of the controller", "Add an excitation to f_n", "declare the"):
        assert text in doubt


def test_undeclared_loop_whose_noise_biases_is_to_be_declared() -> None:
    record = Loop().record(4000, 1, excitation=0.3 * white(3, 4000))
    (origin,) = input_origins([record])
    assert origin.fed_back
    assert not origin.unexcited
    found = feedback_findings([origin], declared=False)
    assert "Declare the loop" in " ".join((*found.doubts, *found.remarks))
    assert feedback_findings([origin], declared=True) == feedback_findings([], declared=True)


def test_loop_that_hardly_shows_is_asked_about() -> None:
    """Noise as large as the excitation: by chance it might be, in one of some thousand records."""
    asked = []
    for seed in range(6):
        record = Loop().record(2000, seed, excitation=0.3 * white(seed, 2000))
        (origin,) = input_origins([record])
        found = feedback_findings([origin], declared=False)
        asked.append(bool(found.doubts or found.remarks))
        assert feedback_findings([origin], declared=True).remarks == ()
    assert sum(asked) >= 3


def test_open_loop_is_not_asked_about() -> None:
    for seed in range(20):
        (origin,) = input_origins([Loop().record(ROWS, seed, given=white(seed, ROWS))])
        assert feedback_findings([origin], declared=False) == feedback_findings([], declared=False)
