"""Test import and identification on measured data of an inverted pendulum in a control loop.

tests/measured/qube/README.md names the source. tests/pendulum_likelihood.py fits the same
model to the same rows without levid's code.
"""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pendulum_likelihood as independent
import pytest
from repository_folders import ROOT

from levid.log.reader import read_log

DATA = ROOT / "tests" / "measured" / "qube"
ROWS = 707
HELD_OUT_ROWS = 177
"""A quarter of the rows, which no fit uses."""


@pytest.fixture(scope="module")
def table() -> np.ndarray:
    return np.genfromtxt(DATA / "qube.csv", delimiter=",", names=True)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, run_levid: Callable[..., int]) -> Path:
    path = tmp_path_factory.mktemp("qube") / "qube.mcap"
    arguments = (DATA / "qube.csv", "--signals", DATA / "signals.yaml", "-o", path)
    assert run_levid("import", *arguments) == 0
    return path


@pytest.fixture(scope="module")
def result(log: Path, run_levid: Callable[..., int]) -> dict[str, Any]:
    """Return the JSON of `levid identify`; a given order of the black-box models saves time."""
    model, out = DATA / "model.yaml", io.StringIO()
    arguments = ("--model", model, "--order", 4, "--out", log.parent / "out", "--json")
    with contextlib.redirect_stdout(out):
        assert run_levid("identify", log, *arguments) == 0
    found: dict[str, Any] = json.loads(out.getvalue())
    return found


def test_published_controller_gives_every_recorded_voltage(table: np.ndarray) -> None:
    """Detects an altered value: one encoder count more or less changes a voltage by 0.2 V."""
    errors = [table[f"target_{name}"] - table[name] for name in ("theta", "alpha")]
    moved = np.diff(1.8 * errors[0] + 2.5 * errors[1])
    proportional = -6.0 * errors[0] - 30.0 * errors[1] + table["feedforward"]
    derivative = proportional[0] - table["plant_input"][0]
    for row, step in enumerate(moved, start=1):
        derivative = (50.0 * step + derivative) / 1.1
        # Angles have a rounding error of 5e-7 rad, and the derivative a gain of 114 V/rad.
        expected = proportional[row] - derivative
        assert table["plant_input"][row] == pytest.approx(expected, abs=4e-4), row


def test_import_keeps_every_value(log: Path, table: np.ndarray) -> None:
    read = read_log(log)
    assert (read.rate_hz, len(read.rows)) == (500.0, ROWS)
    for name, column in (("u_v", "plant_input"), ("theta_rad", "theta"), ("alpha_rad", "alpha")):
        np.testing.assert_array_equal(read.field(name), table[column])


def test_parameters_are_those_of_an_independent_fit(
    result: dict[str, Any], table: np.ndarray
) -> None:
    """Both maximise the likelihood of one model; numbers differ by less than they are uncertain.

    The start of the record is treated differently, which costs up to a quarter of a standard error.
    """
    rows = slice(0, ROWS - HELD_OUT_ROWS)
    angles = np.column_stack((table["theta"], table["alpha"]))
    values, variances = independent.fit(table["plant_input"][rows], angles[rows])
    grey = result["grey_box"]
    for name, value in values.items():
        found = grey["parameters"][name]
        assert found["value"] == pytest.approx(value, abs=0.5 * found["se"]), name
    assert grey["noise"]["output_variance"] == pytest.approx(variances, rel=0.05)


def test_measured_noise_is_the_encoders_quantisation(result: dict[str, Any]) -> None:
    """Estimated from the data alone; 530 rows give a variance within 12 % (two standard errors)."""
    variances = result["grey_box"]["noise"]["output_variance"]
    assert variances == pytest.approx([independent.QUANTISATION_RAD2] * 2, rel=0.2)


def test_parameters_agree_with_the_pendulums_dimensions(result: dict[str, Any]) -> None:
    """A uniform rod of 24 g and 129 mm at the end of an arm of 85 mm, within 15 %.

    The pendulum is no uniform rod: it has a hub and a magnet.
    """
    parameters = result["grey_box"]["parameters"]
    assert parameters["j"]["value"] == pytest.approx(0.024 * 0.129**2 / 3.0, rel=0.15)
    assert parameters["c"]["value"] == pytest.approx(0.024 * 0.085 * 0.0645, rel=0.15)


def test_stated_controller_is_recognised_and_the_loop_is_simulated(result: dict[str, Any]) -> None:
    """The free run of the unstable plant in its loop stays within 10 % of the output."""
    assert not any("did not command" in note for note in result["notes"])
    (check,) = result["grey_box"]["validation"]
    assert check["metric"] == "free_run"
    assert max(check["percent"]) < 10.0
    assert max(check["one_step_percent"]) < 2.0


def test_black_box_has_the_unstable_pole(result: dict[str, Any]) -> None:
    """The controller uses the angles of the same row, which a direct term would take for the plant.

    The declared model has a pole of 13.8 1/s. With a direct term the estimate was 7.9 +- 1.0 1/s.
    """
    (point,) = result["points"]
    A = np.array(point["predictor"]["A"])
    rates = np.log(np.abs(np.linalg.eigvals(A)).max()) * 500.0
    assert rates == pytest.approx(13.8, abs=2.6)  # two half widths of its 95 % interval


def test_trace_names_nothing_where_encoder_steps_hide_small_effects(
    log: Path, run_levid: Callable[..., int]
) -> None:
    out = io.StringIO()
    arguments = ("--model", DATA / "model.yaml", "--out", log.parent / "trace", "--json")
    with contextlib.redirect_stdout(out):
        assert run_levid("trace", log, *arguments) == 0
    found = json.loads(out.getvalue())
    assert found["effects"] == []
    assert found["validation"]["noise_floor"] is None
    assert "no effect is confirmed" in found["unexplained"]["found"]
    assert (log.parent / "trace" / "index.html").exists()
