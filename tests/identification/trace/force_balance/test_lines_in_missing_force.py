"""Test that vibrations are found in moving records, and none where inputs are lines themselves."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from levid.benchmarks.trace.random_forces_in_loops import TS_S, Axis, declared
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_balance.lines_in_missing_force import missing_lines
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import TraceRecord, imported_trace_record
from levid.identification.trace.records.spectral_lines import lines_of
from levid.model.effects.base import Effect, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

Array = NDArray[np.float64]
Effects = Callable[[Places, Extent], Sequence[Effect]]

ROWS, SECONDS = 9000, 18.0
LINES = ((8.1, 0.15), (8.5, 0.1))
"""Frequencies in Hz, and amplitudes over the deviation of the command."""


FORCE = "vibration.force."


def records(
    seed: int, tones: bool = False, shaken: bool = True, begins: tuple[float, ...] = (0.0, 30.0)
) -> tuple[Axis, list[TraceRecord]]:
    """Return records of an axis, with two close lines in the force, or none.

    tones: the command is two sinusoids, and the axis has a cubic spring.
    """
    rng = np.random.default_rng(seed)
    axis = Axis.drawn("nothing missing", rng)
    config, found = declared(axis, rng), []
    for begin in begins:
        t = begin + TS_S * np.arange(ROWS)
        u = _command(axis, t, rng, tones)
        force = sum(a * u.std() * np.sin(2.0 * np.pi * f * t + 1.0) for f, a in LINES)
        y = _moved(axis, u, force if shaken else 0.0 * t, cubic=tones)
        y = y + 1e-3 * y.std() * rng.standard_normal(ROWS)
        e = Experiment("r", TS_S, u[:, None], y[:, None], {}, frozenset(), False)
        record = imported_trace_record(e, config)
        record.time_s[:] = t
        found.append(record)
    return axis, found


def _command(axis: Axis, t: Array, rng: np.random.Generator, tones: bool) -> Array:
    size = 0.01 * axis.k1
    if tones:
        return np.asarray(size * (np.sin(2 * np.pi * 1.7 * t) + np.sin(2 * np.pi * 2.9 * t)))
    steps = rng.standard_normal(ROWS)
    return np.asarray(size * np.convolve(steps, np.ones(25) / 5.0, mode="same"))


def _moved(axis: Axis, u: Array, force: Array, cubic: bool) -> Array:
    q, v, h = 0.0, 0.0, TS_S / 10
    k3 = 0.5 * axis.k1 / 0.01**2 if cubic else 0.0
    y = np.zeros(ROWS)
    pairs = zip(u.tolist(), force.tolist(), strict=True)
    for row, (command, more) in enumerate(pairs):
        y[row] = q
        for _ in range(10):
            v += h * (command + more - axis.d1 * v - axis.k1 * q - k3 * q**3) / axis.m1
            q += h * v
    return y


def trace(found: list[TraceRecord], seed: int, effects: Effects = lambda *_: ()) -> ForceTrace:
    """Return the trace with a table of effects; without one, a fit of the declared model."""
    rng = np.random.default_rng(seed)
    config = declared(Axis.drawn("nothing missing", rng), rng)
    return trace_records(found, config, effects, lambda *_: None)


def test_two_close_lines_are_found_with_frequency_and_amplitude() -> None:
    axis, flown = records(5)
    told = trace(flown, 5, all_effects)
    members = [(r, *r.alternatives) for r in told.found.rated]
    forces = [m.placed for own in members for m in own if m.placed.effect.key.startswith(FORCE)]
    assert len(members) == len(forces) == 2
    size = np.mean([r.experiment.u.std() for r in flown])
    got = sorted((p.shape[0], float(np.hypot(*p.amplitudes))) for p in forces)
    for (f_hz, amplitude), (true_hz, share) in zip(got, LINES, strict=True):
        assert f_hz == pytest.approx(true_hz, abs=1e-3)
        assert amplitude == pytest.approx(share * size, rel=0.05)
    values = dict(zip(told.found.point.parameters.names, told.found.point.values, strict=True))
    assert values["m1"] == pytest.approx(axis.m1, rel=0.01)


def test_without_a_vibration_there_is_no_line() -> None:
    _, flown = records(7, shaken=False)
    told = trace(flown, 7)
    assert missing_lines(told.declared, told.fitted) == ()


def test_harmonics_of_tones_are_no_vibrations() -> None:
    _, flown = records(8, tones=True, shaken=False)
    told = trace(flown, 8)
    left = told.fitted[0].varying(told.fitted[0].missing_force(told.declared))
    assert lines_of(left[:, 0], told.fitted[0].band.row_s)
    assert missing_lines(told.declared, told.fitted) == ()


def test_line_is_a_force_or_a_pick_up_of_the_sensor() -> None:
    """One sensor of a linear axis cannot tell which."""
    _, flown = records(5)
    for found in trace(flown, 5, all_effects).found.rated:
        classes = {r.placed.effect.effect_class for r in (found, *found.alternatives)}
        assert classes == {"vibration", "sensor_pickup"}
