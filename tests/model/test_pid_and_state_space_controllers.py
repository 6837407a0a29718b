"""Controllers against their laws written out as loops, and against each other."""

from __future__ import annotations

import numpy as np
import pytest

from levid.config.base import ConfigError, parse_text
from levid.config.controller import ControllerConfig
from levid.identification.greybox.experiment.controller_file import controller_of_config
from levid.model.controller import Controller, pi_controller

TS = 2e-3
ROWS = 300
RNG = np.random.default_rng(3)
R, Y = RNG.normal(size=(ROWS, 1)), RNG.normal(size=(ROWS, 1))
NOTHING = np.zeros((ROWS, 1))


def controller(text: str, inputs=("u",), outputs=("y",)) -> Controller:
    config = parse_text(text, ControllerConfig, "controller")
    return controller_of_config(config, inputs, outputs, TS)[0]


def commands(text: str, v=NOTHING) -> np.ndarray:
    return controller(text).output(R, Y, v)[0][:, 0]


def test_pid_in_parallel_form_with_derivative_filter_and_limits() -> None:
    text = """
pid:
  u: {loops: [{measured: y, reference: r, kp: 2.0, ki: 30.0, kd: 0.02, derivative_filter_s: 0.01}],
      limits: [-3.0, 2.0], tracking_s: 0.05}
"""
    v = 0.5 * R
    integral = filtered = last = 0.0
    expected = []
    for r, y, extra in zip(R[:, 0], Y[:, 0], v[:, 0], strict=True):
        e = r - y
        integral += 30.0 * TS * e
        filtered = (0.01 * filtered + 0.02 * (e - last)) / (0.01 + TS)
        last = e
        wanted = 2.0 * e + integral + filtered + extra
        expected.append(min(max(wanted, -3.0), 2.0))
        integral += TS / 0.05 * (expected[-1] - wanted)
    found = commands(text, v)
    assert np.count_nonzero(np.isin(found, (-3.0, 2.0))) > 50
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("form", "gains"),
    [("ideal", (2.3, 2.3 / 0.1, 2.3 * 0.03)), ("series", (2.3 * 1.3, 2.3 / 0.1, 2.3 * 0.03))],
)
def test_ideal_and_series_forms_are_parallel_ones(form, gains) -> None:
    """kp (1 + 1/(ti s)) (1 + td s) has the proportional gain kp (1 + td/ti), 1.3 kp here."""
    times = f"form: {form}, kp: 2.3, ti_s: 0.1, td_s: 0.03"
    plain = "kp: {}, ki: {}, kd: {}".format(*gains)
    one, other = (
        commands(f"pid: {{u: {{loops: [{{measured: y, reference: r, {keys}}}]}}}}")
        for keys in (times, plain)
    )
    np.testing.assert_allclose(one, other, atol=1e-10)


def test_cascade_with_averaged_rate() -> None:
    """The law of the EMPS benchmark: u = kv (kp (r - y) - mean rate of the last two samples)."""
    text = """
pid:
  u:
    loops:
      - {measured: y, reference: r, kp: 160.0}
      - {measured: y, rate: true, average: 2, kp: 240.0}
"""
    mean = 0.5 * (Y[1:, 0] + Y[:-1, 0])
    expected = 240.0 * (160.0 * (R[2:, 0] - Y[2:, 0]) - np.diff(mean) / TS)
    np.testing.assert_allclose(commands(text)[2:], expected, rtol=1e-12)


def test_state_space_law_of_two_inputs_selects_its_signals() -> None:
    text = """
state_space: {drives: [b, a], w: [y2, r, y1], A: [[0.5]], B: [[1.0, 2.0, 3.0]],
  C: [[1.0], [0.0]], D: [[0.0, 0.0, 1.0], [5.0, 0.0, 0.0]]}
"""
    c = controller(text, ("a", "b"), ("y1", "y2"))
    y = RNG.normal(size=(ROWS, 2))
    found, _ = c.output(R, y, np.zeros((ROWS, 2)))
    x = 0.0
    for k in range(ROWS):
        np.testing.assert_allclose(found[k], [5.0 * y[k, 1], x + y[k, 0]], atol=1e-12)
        x = 0.5 * x + y[k, 1] + 2.0 * R[k, 0] + 3.0 * y[k, 0]


def test_delay_rows_shift_the_command() -> None:
    law = "pid: {u: {loops: [{measured: y, reference: r, kp: 2.0, ki: 30.0}]}}"
    now, later = commands(law), commands(f"{law}\ndelay_rows: 2")
    np.testing.assert_allclose(later[2:], now[:-2], atol=1e-12)
    assert not later[:2].any()


def test_actuator_is_a_first_order_lag_behind_the_controller() -> None:
    """A voltage behind R and L gives a current: exact for a voltage held over each row."""
    law = "loops: [{measured: y, reference: r, kp: 2.0}]"
    lagged = commands(f"pid: {{u: {{{law}, actuator_gain: 0.005, actuator_lag_s: 0.003}}}}")
    volts, current = commands(f"pid: {{u: {{{law}}}}}"), 0.0
    for k in range(ROWS):
        assert lagged[k] == pytest.approx(current, abs=1e-12)
        current += (0.005 * volts[k] - current) * (1 - np.exp(-TS / 0.003))


def test_state_follows_from_recorded_commands() -> None:
    c = controller("pid: {u: {loops: [{measured: y, reference: r, kp: 2.0, ki: 30.0, kd: 0.02}]}}")
    x0 = np.array([0.7, -0.3, 1.1])
    u, end = c.output(R, Y, NOTHING, x0)
    found = c.state_from(R, Y, NOTHING, u)
    # The filtered derivative of a filter of 0 s is overwritten unread: its initial state has no
    # effect on the commands, and counts as zero.
    np.testing.assert_allclose(found, [0.7, -0.3, 0.0], atol=1e-9)
    np.testing.assert_allclose(c.output(R, Y, NOTHING, found)[1], end, atol=1e-9)


def test_response_is_that_of_the_pi_law() -> None:
    kp, ki = np.array([20.0, 500.0]), np.array([200.0, 0.0])
    freq_hz = np.geomspace(0.1, 200.0, 9)
    z = np.exp(2j * np.pi * freq_hz * TS)
    found = pi_controller(kp, ki, TS).response(freq_hz)
    np.testing.assert_allclose(found[:, 0, 0], kp[0] + ki[0] * TS * z / (z - 1), rtol=1e-12)
    np.testing.assert_allclose(found[:, 1, 1], kp[1])
    assert not found[:, 0, 1].any()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "expected either pid or state_space"),
        (
            "pid: {u: {loops: [{measured: y, kp: 1, ti_s: 2}]}}",
            "ki and kd with form parallel",
        ),
        ("pid: {u: {loops: [{measured: y, kp: 1, form: ideal, ki: 2}]}}", "expected ti_s and td_s"),
        (
            "pid: {u: {loops: [{measured: y, kp: 1}, {measured: y, kp: 1, reference: r}]}}",
            "reference in the first loop only",
        ),
        ("pid: {u: {loops: [{measured: y, kp: 1}], limits: [1, 0]}}", "[low, high]"),
        ("pid: {u: {loops: [{measured: y, kp: 1}], tracking_s: 1}}", "limits, and an integral"),
        ("state_space: {drives: [u], w: [y], D: [[1, 2]]}", "D: expected 1 rows of 1 numbers"),
    ],
)
def test_mistakes_are_named(text: str, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_text(text, ControllerConfig, "controller")
    assert words in str(error.value)
