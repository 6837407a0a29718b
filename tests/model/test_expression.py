"""Expressions of any length and depth have a value or an error in words."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from levid.config.shipped import shipped
from levid.model.expression import Expression, ExpressionError

_MODEL = """
levid: model
name: mass
dof: [{{name: x_m, unit: m}}]
inputs: [{{name: f_n, unit: N}}]
parameters:
  m: {{value: 2.0, unit: kg, min: 0.1, max: 20}}
M: [["{text}"]]
D: [[12.0]]
K: [[800.0]]
"""
DEEP = [
    "(" * 1900 + "m" + ")" * 1900,
    "sin(" * 150 + "m" + ")" * 150,
    "-" * 900 + "m",
    "-" * 3900 + "m",
    "2" + "**2" * 100,
    "2" + "**2" * 1300,
    "m" + ".m" * 1900,
    "m" + "[m]" * 500,
    "m if m else " * 300 + "m",
    "lambda: " * 400 + "m",
    "[" * 150 + "m" + "]" * 150,
    "f(" * 150 + "m" + ")" * 150,
    "m+" * 10_000 + "m",
    "9" * 3900,
    "9" * 100_000,
    "1e" + "9" * 3000,
    "9**9**9",
    "9**9**9**9**9",
    "exp(exp(exp(9)))",
    "m/(m-m)",
    "1if 1else 2",
    "m\0",
]


@pytest.mark.parametrize("text", DEEP, ids=lambda text: f"{text[:12]}_{len(text)}")
def test_no_expression_gives_a_traceback(
    text: str, tmp_path: Path, levid: Callable[..., Any], recwarn: pytest.WarningsRecorder
) -> None:
    with pytest.raises(ExpressionError):
        Expression.parse(text)({"m": 2.0})
    model = tmp_path / "model.yaml"
    model.write_text(_MODEL.format(text=text.replace("\0", "\\0")))
    code, _, err = levid("check", model)
    assert code == 1
    assert all(line.startswith(str(model)) for line in err.splitlines())
    assert len(err) < 1000
    assert not recwarn.list


def test_sums_and_products_may_be_long() -> None:
    assert Expression.parse("+".join(["m"] * 1900))({"m": 2.0}) == 3800.0
    assert Expression.parse("m" + "-1" * 1500)({"m": 2.0}) == -1498.0
    assert Expression.parse("8/2/2*3-1-2**3**1")({}) == 8 / 2 / 2 * 3 - 1 - 8
    assert Expression.parse("2**3**2")({}) == 512.0


@given(st.text("0123456789.eE+-*/() msincxpqrt_,[]=:\n", max_size=60))
def test_random_text_is_a_number_or_an_error(text: str) -> None:
    try:
        value = Expression.parse(text)({"m": 2.0})
    except ExpressionError:
        return
    assert isinstance(value, float)


def test_shipped_models_are_read() -> None:
    from levid.config.model import load_model

    assert load_model(shipped("models/rig.yaml")).name
