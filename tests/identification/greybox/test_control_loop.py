"""The loop of imported records: excitation, set points, and wrong controllers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from levid.config.base import ConfigError, parse_text
from levid.config.model import ModelConfig
from levid.identification.checks_before_fit import check_before_fit
from levid.identification.greybox.experiment.experiment_from_log import (
    Experiment,
    experiment_from_log,
)
from levid.identification.greybox.identify_greybox import identify_grey_box
from levid.identification.options import Options
from levid.log.importing.importer import import_file
from levid.log.importing.signals_yaml import SignalsFile
from levid.log.reader import read_log

TS, ROWS = 0.002, 3000
MASS, UP = 0.5, 300.0
"""A mass on a negative spring, as a magnet below a coil: its pole is at sqrt(UP / MASS)."""
KP, KD, SET_POINT = -900.0, -12.0, 0.003
MODEL = """
levid: model
name: magnet
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
parameters:
  m: {value: 0.6, unit: kg, min: 0.1, max: 2.0}
  up: {value: 200.0, unit: N/m, min: -1000.0, max: 2000.0}
M: [[m]]
D: [[0.0]]
K: [[-up]]
"""
SIGNALS = """
levid: signals
rate_hz: 500
columns:
  - {column: f, name: f_n, unit: N, role: input}
  - {column: x, name: x_m, unit: m, role: output}
"""
LAW = "{measured: x_m, reference: %s, kp: %g, kd: %g, derivative_of: measured}"


def flown(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return columns v, f, x of a flight; the controller pushes back towards the set point."""
    rng, w = np.random.default_rng(seed), np.sqrt(UP / MASS)
    c, s = np.cosh(w * TS), np.sinh(w * TS)
    step = np.array([[c, s / w], [s * w, c]])
    by_force = np.array([(c - 1) / w**2, s / w]) / MASS
    v = lfilter([1.0], [1.0, -0.5], rng.normal(size=ROWS))
    x, last, rows = np.zeros(2), 0.0, []
    for k in range(ROWS):
        y = x[0] + 2e-6 * rng.normal()
        f = -KP * (SET_POINT - y) + KD * (y - last) / TS + v[k]
        rows.append([v[k], f, y])
        last, x = y, step @ x + by_force * (f + 0.05 * rng.normal())
    return np.array(rows).T


def imported(folder: Path, loop: str, more: str = "", seed: int = 1) -> Experiment:
    data, signals = folder / "data.csv", folder / "signals.yaml"
    np.savetxt(data, np.transpose(flown(seed)), delimiter=",", header="v,f,x", comments="")
    signals.write_text(SIGNALS + more + loop)
    log = folder / "data.mcap"
    log.unlink(missing_ok=True)
    import_file(data, signals, log)
    return experiment_from_log(read_log(log), parse_text(MODEL, ModelConfig, "model"))


def loop(reference: object = SET_POINT, factor: float = 1.0) -> str:
    law = LAW % (reference, -KP * factor, -KD * factor)
    return f"loop: {{controller: {{pid: {{f_n: {{loops: [{law}]}}}}}}}}\n"


EXCITATION = "  - {column: v, name: v_n, unit: N, role: excitation}\n"


def test_excitation_and_controller_reproduce_the_command(tmp_path: Path) -> None:
    e = imported(tmp_path, loop(), EXCITATION)
    assert e.loop is not None
    np.testing.assert_allclose(e.loop.v[:, 0], flown()[0])
    assert e.remarks == ()


def test_excitation_that_is_not_recorded_follows_from_the_command(tmp_path: Path) -> None:
    e = imported(tmp_path, loop())
    assert e.loop is not None
    # The state before the first row, the last output, is estimated.
    np.testing.assert_allclose(e.loop.v[2:, 0], flown()[0][2:], atol=1e-6)
    (remark,) = e.remarks
    assert "counts as excitation that was not recorded" in remark


def test_set_point_that_is_not_stated_is_estimated(tmp_path: Path) -> None:
    e = imported(tmp_path, loop().replace(f"reference: {SET_POINT}, ", ""))
    assert e.loop is not None
    # An excitation of unknown mean is a set point, too: only their sum is known.
    found, true = e.loop.reference[0, 0], SET_POINT + flown()[0].mean() / -KP
    assert found == pytest.approx(true, abs=1e-4)


@pytest.mark.parametrize(("factor", "fits"), [(-1.0, -1.0), (0.4, 2.5)])
def test_wrong_controller_is_noticed(tmp_path: Path, factor: float, fits: float) -> None:
    e = imported(tmp_path, loop(factor=factor))
    (remark,) = e.remarks
    assert "the stated controller did not command this record" in remark
    scale = float(remark.partition("The command fits ")[2].split()[0])
    assert scale == pytest.approx(fits, rel=0.3)


@pytest.mark.parametrize(
    ("text", "metric"),
    [(loop(), "free_run"), ("loop: {controller: unknown}\n", "prediction"), ("", "prediction")],
)
def test_unstable_plant_is_identified_in_its_loop(tmp_path: Path, text: str, metric: str) -> None:
    """Its pole is at 24.5 1/s: a simulation without its loop would grow by e^147."""
    config = parse_text(MODEL, ModelConfig, "model")
    e = imported(tmp_path, text)
    grey = identify_grey_box(config, [e], 0.25)
    for name, true in (("m", MASS), ("up", UP)):
        found = grey.fitted.parameters[name]
        assert found.se is not None
        assert found.value == pytest.approx(true, abs=4 * found.se)
        assert found.se < 0.02 * true
    (check,) = grey.validations
    assert check.metric == metric
    assert check.error_percent[0] < 20.0
    assert check.force_percent[0] < 20.0
    # The declared model is unstable already, so this is known before the fit.
    before = check_before_fit((), [e], config, Options())
    assert any("no loop is declared" in remark for remark in before) == (text == "")
    assert not any("Declare the loop" in remark for remark in grey.remarks)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (loop("ref_m"), "expected a column of role reference (declared: none), found 'ref_m'"),
        (
            loop().replace("f_n:", "g_n:"),
            "expected a column of role input (declared: f_n), found 'g_n'",
        ),
        ("loop: {controller: known}\n", "controller"),
        (EXCITATION.replace("}", ", of: y_n}"), "expected one of the inputs f_n, found y_n"),
        (
            EXCITATION.replace("excitation", "other, of: f_n"),
            "of: expected with role excitation only",
        ),
    ],
)
def test_mistakes_in_the_loop_are_named(text: str, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_text(SIGNALS + text, SignalsFile, "signals.yaml")
    assert words in str(error.value)
