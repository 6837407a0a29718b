"""Test discretisation and response of a second-order model with lag and delay."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.model.declared_model import DeclaredModel, ModelError
from levid.model.expression import Expression, ExpressionError
from levid.model.second_order import SecondOrder, discretise, state_space


def declared() -> DeclaredModel:
    return declared_model(load_model(shipped("models/rig.yaml")))


def test_rig_model_gives_the_papers_matrices() -> None:
    x_b = 0.07
    at = declared().at({"x_b": x_b})
    m_p, m_b, z_b, g = 5.6, 1.4, 0.06, 9.81
    np.testing.assert_allclose(  # eq. (2)
        at.M,
        [
            [0.062 + m_b * z_b**2, 0.0015, 0],
            [0.0015, 0.058 + m_b * (z_b**2 + x_b**2), m_b * x_b],
            [0, m_b * x_b, m_p + m_b],
        ],
        rtol=1e-14,
    )
    np.testing.assert_allclose(at.D, np.diag([6 * 0.12**2 * 4] * 2 + [36]), rtol=1e-14)  # (5)
    np.testing.assert_allclose(np.diag(at.K), [210 - z_b * m_b * g, 190 - z_b * m_b * g, 2600])
    np.testing.assert_allclose(at.force, [0, -m_b * g * x_b, -(m_p + m_b) * g])


def test_moving_beam_adds_the_forces_of_its_acceleration() -> None:
    # Lagrangian of a mass at (x_b(t), z_b) on the tilting platform, to second order in the pose:
    # m_b/2 (z_b^2 theta'^2 + (z' + x_b theta')^2 + 2 z' v_b theta - 2 v_b z_b theta').
    x_b, v_b, a_b, m_b = 0.05, 0.3, 2.0, 1.4
    still, moving = declared().at({"x_b": x_b}), declared().at({"x_b": x_b, "v_b": v_b, "a_b": a_b})
    expected = 2 * m_b * v_b * np.array([[0, 0, 0], [0, x_b, 0], [0, 1, 0]])
    np.testing.assert_allclose(moving.D - still.D, expected, atol=1e-15)
    expected = m_b * a_b * np.array([[0, 0, 0], [0, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(moving.K - still.K, expected, atol=1e-13)
    np.testing.assert_allclose(moving.force - still.force, [0, m_b * 0.06 * a_b, 0], atol=1e-15)


@pytest.mark.parametrize("delay_periods", [0.0, 0.25, 1.0, 1.4, 3.0])
@pytest.mark.parametrize("lag_s", [0.0, 3e-4])
@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_sampled_response_equals_the_continuous_response_with_hold(
    delay_periods: float, lag_s: float, hold: Literal["zoh", "foh"]
) -> None:
    # Poisson's formula: the sampled response with hold is a sum over aliases. The rig's response
    # falls at least with the cube of frequency, so 200 aliases are enough.
    Ts = 1e-3
    model = replace(declared().at({"x_b": 0.1}), lag_s=lag_s, delay_s=delay_periods * Ts)
    freq = np.array([0.5, 5.0, 64.0, 300.0])
    sampled = discretise(model, Ts, hold).response(freq)
    total = np.zeros_like(sampled)
    for alias in range(-200, 201):
        f = freq + alias / Ts
        s = 2j * np.pi * f
        held = (1 - np.exp(-s * Ts)) / (s * Ts)
        if hold == "foh":  # foh is zoh applied twice, one period earlier
            held = held**2 * np.exp(s * Ts)
        shape = held * np.exp(-s * model.delay_s) / (1 + s * lag_s)
        total += state_space(model).response(f) * shape[:, None, None]
    np.testing.assert_allclose(sampled, total, atol=1e-6 * np.abs(sampled).max())


def test_static_gain_is_the_inverse_stiffness() -> None:
    model = declared().at()
    gain = discretise(model, 1e-3).response(np.array([0.0]))[0]
    np.testing.assert_allclose(gain.real, np.linalg.inv(model.K), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    "m", [[["a", "a"], ["a", "a"]], [[0.1, 0.3], [0.1, 0.3]], [[0, 0], [0, 1]]]
)
def test_singular_mass_matrix_is_rejected(m: list[list[str | float]]) -> None:
    eye = [[1e-9, 0.0], [0.0, 1e9]]  # units of any size
    DeclaredModel.build("xy", "fg", {}, {"s": 0.1}, {"M": eye, "D": eye, "K": eye}).at()
    model = DeclaredModel.build("xy", "fg", {"a": 0.3}, {"s": 0.1}, {"M": m, "D": eye, "K": eye})
    with pytest.raises(ModelError, match=r"M: expected a mass matrix .* at s = 0\.2"):
        model.at({"s": 0.2})


def test_one_mass_model_of_any_size() -> None:
    model = DeclaredModel.build(
        ["x"], ["f"], {"m": 2.0, "k": 8.0}, {}, {"M": [["m"]], "D": [[0]], "K": [["k"]]}
    ).at()
    assert isinstance(model, SecondOrder)
    # Undamped, 2 rad/s: after half a period, a constant force gives twice the static deflection.
    step = discretise(model, np.pi / 2)
    x = step.B[:, 0]
    np.testing.assert_allclose((step.C @ x)[0], 2 / 8.0, rtol=1e-12)


@pytest.mark.parametrize(
    "text",
    ["__import__('os')", "a.b", "x[0]", "lambda: 1", "1 if x else 2", "'text'", "m_p +", "a<b"],
)
def test_formula_other_than_arithmetic_is_rejected(text: str) -> None:
    with pytest.raises(ExpressionError):
        Expression.parse(text)


@pytest.mark.parametrize("text", ["0x20*m", "1_000", "m + 0b1", "0o7"])
def test_number_of_a_formula_is_decimal(text: str) -> None:
    with pytest.raises(ExpressionError, match="expected decimal numbers, found '"):
        Expression.parse(text)
    assert Expression.parse("2.5e-3*m + .5 + 3.")({"m": 2.0}) == 3.505


@pytest.mark.parametrize("source", ["1e400", "9" * 4000, "9" * 6000, float("nan"), float("inf")])
def test_non_finite_number_in_a_formula_is_rejected(source: str | float) -> None:
    with pytest.raises(ExpressionError, match="expected") as caught:
        Expression.parse(source)
    assert len(str(caught.value)) < 200  # the message quotes only the first digits


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("x**0.5", "integer exponent"),
        ("sqrt(x**0.5)", "integer exponent"),
        ("sqrt(x)", "invalid value"),
        ("1e308*x*x", "finite"),
        ("10**400", "the result is too large"),
    ],
)
def test_formula_without_a_real_finite_value_is_rejected(text: str, why: str) -> None:
    with pytest.raises(ExpressionError, match=f"has no value.*{why}"):
        Expression.parse(text)({"x": -8.0})
    along = np.array([1.0, -8.0])
    with pytest.raises(ExpressionError, match="has no value"):
        Expression.parse(text).over({"x": along})
    assert Expression.parse("x**2")({"x": -8.0}) == 64.0


@pytest.mark.parametrize("lag", [-1e-3, "tau - 2", "1/(tau - 1)"])
def test_negative_lag_is_rejected(lag: str | float) -> None:
    parts = {"M": [[1]], "D": [[0]], "K": [[1]]}
    with pytest.raises(ModelError, match="lag: "):
        DeclaredModel.build(["x"], ["f"], {"tau": 1.0}, {}, parts, lag=lag)
    # A delay is relative to the backends' cycle of delay, so it may be negative.
    ahead = DeclaredModel.build(["x"], ["f"], {}, {}, parts, delay=-1e-4)
    assert ahead.at().delay_s == -1e-4


def test_formula_without_a_value_is_reported() -> None:
    for text in ("1/x", "x**x**x"):
        with pytest.raises(ExpressionError, match="has no value"):
            Expression.parse(text)({"x": 0.0 if text == "1/x" else 1e3})


def test_model_errors_name_matrix_and_entry() -> None:
    with pytest.raises(ModelError, match=r"K\[0\]\[0\].*\['stiffness'\]"):
        DeclaredModel.build(
            ["x"], ["f"], {"m": 1.0}, {}, {"M": [["m"]], "D": [[0]], "K": [["stiffness"]]}
        )
    with pytest.raises(ModelError, match="M: expected 2 rows of 2 entries"):
        DeclaredModel.build(["x", "y"], ["f", "g"], {}, {}, {"M": [[1]], "D": [[0]], "K": [[0]]})
