"""Readings that stand still, or are off the plane of the others, are a fault that names them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from levid.benchmarks.daemon.hours_without_false_alarm import bending_sim
from levid.benchmarks.daemon.spoilt_flight import PHASES, fly
from levid.config.rig import RigConfig, load_rig
from levid.config.shipped import shipped
from levid.daemon.control.plane_residual import plane_text, residual_projector, suspects
from levid.daemon.control.sensor_checks import SensorChecks, checks_size
from levid.daemon.control.sensor_limits import undetectable
from levid.daemon.control.standing_readings import (
    repeat_probability,
    repeats_until_found,
    rest_noise,
)
from levid.log.signals import cycle_dtype
from levid.model.geometry import shape_matrix

RIG = load_rig(shipped("rigs/loopback.yaml"))
STEP_M = 2e-3 / 2**16
GRID = (0.12, 0.0, -0.12)
LONGEST = 26
"""Repeats until 200 readings with noise of 3.3 steps are found: 17 with the true noise."""
NO_STEP_M = 1e-12


def with_sensors(x_m: tuple[float, ...], y_m: tuple[float, ...]) -> RigConfig:
    geometry = RIG.geometry.model_copy(update={"sensor_x_m": x_m, "sensor_y_m": y_m})
    return RIG.model_copy(update={"geometry": geometry})


def quantised(noise_steps: float, n: int, channels: int = 20) -> np.ndarray:
    rng = np.random.default_rng(1)
    height = rng.uniform(0.0, 1.0, channels) + noise_steps * rng.normal(size=(n, channels))
    return np.rint(height) * STEP_M - 9e-4


@pytest.mark.parametrize("noise_steps", [0.0, 0.1, 0.3, 0.4, 0.7, 1.0, 3.3, 100.0])
@pytest.mark.parametrize("n", [40, 200, 500])
def test_repeats_that_are_allowed_are_never_fewer_than_the_true_noise_asks(
    noise_steps: float, n: int
) -> None:
    """The bound holds with 99.9 % in each of twenty channels."""
    found = rest_noise(quantised(noise_steps, n), NO_STEP_M)
    truth = repeats_until_found(repeat_probability(1.0, noise_steps), 9, 1000.0)
    allowed = [repeats_until_found(p, 9, 1000.0) for p in found.repeat]
    assert min(allowed) >= min(truth, 1e4)  # where fewer than 1e-3 leave the step, none is seen
    if noise_steps >= 0.7 and n >= 200:
        assert max(allowed) < 5 * truth + 10


def test_machine_that_shakes_the_platform_slowly_is_no_noise_of_the_sensors() -> None:
    """It may stop, and then the readings repeat as the sensors' own noise has it."""
    sound = quantised(0.0, 200)
    shaken = np.rint(sound / STEP_M + 5.0 * np.sin(0.3 * np.arange(200))[:, None]) * STEP_M
    assert np.all(rest_noise(shaken, NO_STEP_M).repeat == 1.0)


def test_converter_that_is_slower_than_the_cycle_may_repeat() -> None:
    found = rest_noise(np.repeat(quantised(3.0, 50), 4, axis=0), NO_STEP_M)
    assert np.all(found.repeat > 0.75)


@pytest.mark.parametrize("phase", PHASES[1:])
@pytest.mark.parametrize("which", ["all", "4", "2,5"])
def test_standing_readings_are_a_fault_within_26_cycles(phase: str, which: str) -> None:
    found = fly(f"frozen {which}", phase)
    assert found.fault == "SENSOR"
    names = {
        "all": "all 9 sensors repeat",
        "4": "sensor 4 repeats",
        "2,5": "sensors 2 and 5 repeat",
    }
    assert names[which] in found.text
    assert found.cycles <= LONGEST
    assert found.later_n < 0.05  # the readback's noise


def test_old_readings_are_no_repeats() -> None:
    """A device that does not answer for 100 cycles is the bus's fault, if it is one."""
    assert fly("gain 4 1.0", missing=(0.1, 100)).fault == ""


@pytest.mark.parametrize("phase", PHASES[1:])
def test_sensor_that_is_off_is_named_with_its_error(phase: str) -> None:
    found = fly("off 8 0.0005", phase)
    assert found.fault == "SENSOR"
    assert "sensor 8 " in found.text
    said = re.search(r"([0-9.]+) mm", found.text)
    assert said is not None
    assert float(said[1]) == pytest.approx(0.5, rel=0.01)  # while the platform moves
    assert found.cycles <= 23  # 0.1 s ln(0.5 / 0.4)
    assert found.later_n < 0.05


@pytest.mark.parametrize("line", ["off 0 0.00015", "drift 3 0.0002", "intermittent 6 0.0003"])
def test_small_slow_and_intermittent_errors_are_found(line: str) -> None:
    found = fly(line, "hover", 0.1, hover_s=2.0)
    assert found.fault == "SENSOR"
    assert f"sensor {line.split()[1]} " in found.text
    assert found.gap_m < 2e-4


@pytest.mark.parametrize("sim", ["nominal", "rig"])
@pytest.mark.parametrize("line", ["gain 1 1.03", "gain 8 0.97", "spike 2 0.0001", "off 4 0.00008"])
def test_small_errors_are_no_fault(line: str, sim: str) -> None:
    assert fly(line, "idle", sim=shipped(f"sims/{sim}.yaml")).fault == ""


@pytest.mark.parametrize("bits", [12, 16])
def test_a_platform_that_bends_is_no_fault(tmp_path: Path, bits: int) -> None:
    """A sensor may stand still for some cycles while the others move: it is near a node."""
    sim = bending_sim(tmp_path, _sim(tmp_path, bits, "1e-7").read_text())
    assert fly("gain 1 1.0", sim=sim).fault == ""


@pytest.mark.parametrize("noise", ["0", "1e-9", "1e-7"])
@pytest.mark.parametrize("bits", [8, 12, 16, 32])
def test_converters_of_any_step_and_noise_give_no_false_alarm(
    tmp_path: Path, bits: int, noise: str
) -> None:
    sim = _sim(tmp_path, bits, noise)
    assert fly("gain 1 1.0", sim=sim, hover_s=3.0).fault == ""


def test_force_that_must_move_the_platform_finds_coarse_readings_that_stand(
    tmp_path: Path,
) -> None:
    """They repeat at rest: noise of 0.1 um, steps of 0.49 um."""
    found = fly("frozen all", "excitation", 0.1, sim=_sim(tmp_path, 12, "1e-7"))
    assert found.fault == "SENSOR"
    assert "while the commanded force changed" in found.text
    assert found.gap_m < 2e-4


def test_sensor_that_repeats_where_it_had_noise_fails_the_next_self_test() -> None:
    checks = SensorChecks(RIG, 1e-3, np.zeros(checks_size(9)))
    rows = np.zeros(200, cycle_dtype(9, 9))
    rows["gap_m"] = quantised(3.3, 200, 9)
    assert checks.learn(rows) == ""
    rows["gap_m"][:, 3] = rows["gap_m"][0, 3]
    assert checks.learn(rows) == "sensor 3 repeats its reading at rest, with noise before"


@pytest.mark.parametrize(
    ("x_m", "y_m", "off", "named"),
    [
        ((0.12, 0.12, -0.12, -0.12), (0.12, -0.12, 0.12, -0.12), 2, [0, 1, 2, 3]),
        ((0.1, -0.1, 0.0, 0.0, 0.05), (0.0, 0.0, 0.1, -0.1, 0.05), 4, [4]),
        ((0.1, 0.1, -0.1, -0.1, 0.0), (0.1, -0.1, 0.1, -0.1, 0.0), 0, [0, 3]),
    ],
)
def test_sensors_that_cannot_be_told_apart_are_all_named(
    x_m: tuple[float, ...], y_m: tuple[float, ...], off: int, named: list[int]
) -> None:
    found = residual_projector(x_m, y_m)
    error = np.zeros(len(x_m))
    error[off] = 3e-4
    residual = found.projector @ (error + shape_matrix(x_m, y_m) @ [1e-3, -2e-3, 4e-4])
    assert sorted(suspects(residual, found.projector)) == named
    text = plane_text(residual, residual, found.projector, 1e-4)
    assert "0.300 mm off the plane" in text
    assert ("too few sensors to tell which one" in text) == (len(named) > 1)
    assert (named in found.alike) == (len(named) > 1)


def test_check_says_which_errors_cannot_be_detected() -> None:
    three = with_sensors((0.12, -0.12, 0.0), (0.12, 0.12, -0.12))
    assert "cannot be detected" in undetectable(three)[0]
    four = with_sensors((0.12, 0.12, -0.12, -0.12), (0.12, -0.12, 0.12, -0.12))
    assert "it may be any of these: sensor 0, 1, 2 or 3" in undetectable(four)[0]
    line = with_sensors((0.12, 0.0, -0.12, 0.05), (0.0, 0.0, 0.0, 0.1))
    assert "if sensor 3 is off, it cannot be detected" in undetectable(line)[0]
    assert undetectable(RIG) == []


def _sim(folder: Path, bits: int, noise: str) -> Path:
    text = shipped("sims/nominal.yaml").read_text()
    text = text.replace("noise_m: 1e-7", f"noise_m: {noise}").replace("bits: 16", f"bits: {bits}")
    sim = folder / "sim.yaml"
    sim.write_text(text)
    return sim
