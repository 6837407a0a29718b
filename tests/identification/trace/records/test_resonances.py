"""Test the detection of flexible modes from records; scipy simulates the modes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_test_helpers import rig_places
from scipy import signal

from levid.identification.greybox.experiment.control_loop import ControlLoop
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.records.record_from_log import TraceRecord
from levid.identification.trace.records.resonances import resonances
from levid.model.controller import pi_controller
from levid.model.effects.base import Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.flexible import PATTERNS, patterns
from levid.model.effects.operating_range import Extent

PLACES = rig_places()
NAMES, OVER_SENSORS, OVER_COILS = patterns(PLACES)
NOISE_M, FORCE_N, MASS_KG = 1e-7, 0.3, 5.0
SECONDS = 25.0


def excited(seed: int, Ts_s: float = 1e-3, places: Places = PLACES) -> TraceRecord:
    """Return a record of a rigid platform at rest with independent excitation of its coils."""
    rng, rows = np.random.default_rng(seed), round(SECONDS / Ts_s)
    nothing = np.zeros((rows, 3))
    schedule = {name: np.zeros(rows) for name in ("x_b", "v_b", "a_b")}
    silent = pi_controller(np.zeros(3), np.zeros(3), Ts_s)
    loop = ControlLoop(nothing, nothing, nothing, nothing, silent)
    coil = 7.6 + FORCE_N * rng.standard_normal((rows, places.coils))
    experiment = Experiment(
        "coils", Ts_s, nothing, nothing, schedule, frozenset({"a_b"}), False, 1, loop, hold="zoh"
    )
    gap = NOISE_M * rng.standard_normal((rows, places.sensors))
    return TraceRecord(
        experiment, places, np.arange(rows) * Ts_s, gap, coil, np.zeros_like(coil), nothing,
        nothing, None, "coils",
    )  # fmt: skip


def with_mode(record: TraceRecord, pattern: str, f_hz: float, zeta: float) -> TraceRecord:
    """Add the motion of a mode; forces act one cycle late with a zero-order hold."""
    i, w = NAMES.index(pattern), 2 * np.pi * f_hz
    mode = signal.StateSpace([[0, 1], [-(w**2), -2 * zeta * w]], [[0], [1]], [[1, 0]], [[0]])
    sampled = mode.to_discrete(record.experiment.Ts_s)
    force = np.roll(record.coil @ OVER_COILS[:, i], 1) / MASS_KG
    _, eta, _ = signal.dlsim(sampled, force - force.mean())
    return replace(record, gap=record.gap + eta @ OVER_SENSORS[:, [i]].T)


@pytest.mark.parametrize(
    ("pattern", "f_hz", "zeta"),
    [
        ("twist", 31.7, 0.02),
        ("saddle", 115.0, 0.01),
        ("dome", 68.0, 0.004),
        ("wave_x", 210.0, 0.05),
    ],
)
def test_narrow_resonance_is_found_with_its_frequency_and_damping(
    pattern: str, f_hz: float, zeta: float
) -> None:
    records = [with_mode(excited(seed), pattern, f_hz, zeta) for seed in (1, 2)]
    (found,) = resonances(records)
    assert found.pattern == pattern
    assert found.frequency_hz == pytest.approx(f_hz, rel=0.005)
    # A Hann window of 4 s has a width of 0.36 Hz at half its height. The narrowest resonance has a
    # half-width of 0.27 Hz, which appears 50 % wider.
    assert found.damping == pytest.approx(zeta, rel=0.6)


def test_two_resonances_of_one_pattern_are_both_found() -> None:
    record = with_mode(with_mode(excited(3), "saddle", 60.0, 0.01), "saddle", 140.0, 0.01)
    found = resonances([record])
    assert {r.pattern for r in found} == {"saddle"}
    assert sorted(r.frequency_hz for r in found) == pytest.approx([60.0, 140.0], rel=0.005)


def test_noise_and_wrong_sensor_gains_give_no_resonance() -> None:
    for seed in range(6):
        record = excited(seed)
        moves = 1e-5 * np.sin(2 * np.pi * 20.0 * record.time_s)
        gap = record.gap.copy()
        gap[:, 4] += 0.02 * moves
        assert resonances([replace(record, gap=gap)]) == ()


def test_records_of_other_rates_unknown_positions_or_no_force_give_no_resonance() -> None:
    slow, fast = excited(1, 4e-3), with_mode(excited(2), "twist", 40.0, 0.01)
    assert [r.pattern for r in resonances([slow, fast])] == ["twist"]
    unknown = replace(PLACES, sensor_xy_m=np.zeros((0, 2)), coil_xy_m=np.zeros((0, 2)))
    assert resonances([replace(fast, places=unknown)]) == ()
    nothing = replace(fast, coil=np.zeros_like(fast.coil))
    assert resonances([nothing]) == ()


def test_detected_resonance_is_in_the_search_grid_of_its_mode_only() -> None:
    covered = replace(Extent.typical(PLACES), resonances=(("saddle", 115.0, 0.01),))
    modes = {e.key: e for e in all_effects(PLACES, covered)}
    assert modes["flexible_mode.saddle"].grid[-1][:2] == (115.0, 0.01)
    others = [modes[f"flexible_mode.{name}"] for name in PATTERNS if name != "saddle"]
    assert all(row[:2] != (115.0, 0.01) for mode in others for row in mode.grid)
