"""Test units of numbers that must be in SI."""

from __future__ import annotations

import pytest

from levid.config.base import ConfigError, parse_text
from levid.config.model import ModelConfig
from levid.config.units import si_slip

MODEL = """
levid: model
name: mass
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
parameters: {m: {value: 2.0, unit: UNIT}}
M: [[m]]
D: [[0]]
K: [[0]]
"""


@pytest.mark.parametrize(
    "unit",
    ["kg", "kg m^2", "N m s/rad", "1", "V/V", "m/s^2", "1/s", "Hz", "widgets", "Pa s", "s^-2"],
)
def test_si_and_unknown_units_pass(unit: str) -> None:
    assert si_slip(unit) is None


@pytest.mark.parametrize(
    ("unit", "said"),
    [
        ("g", "expected an SI unit with kg, found g: a gram is 1e-3 kg"),
        ("g m^2", "a gram is 1e-3 kg"),
        ("mm", "found mm: use m, and the value times 0.001"),
        ("N/mm", "found N/mm: use N/m, and the value times 1000"),
        ("deg", "found deg: use rad, and the value times 0.0174533"),
        ("rpm", "use rad/s, and the value times 0.10472"),
    ],
)
def test_a_parameter_in_another_unit_is_an_error(unit: str, said: str) -> None:
    parse_text(MODEL.replace("UNIT", "kg"), ModelConfig, "model")
    with pytest.raises(ConfigError, match=r"parameters\.m\.unit: ") as caught:
        parse_text(MODEL.replace("UNIT", unit), ModelConfig, "model")
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("{name: x, unit: m}", "{name: x, unit: mm}", "dof[0].unit"),
        ("{name: f, unit: N}", "{name: f, unit: kN}", "inputs[0].unit"),
    ],
)
def test_a_motion_or_an_input_in_another_unit_is_an_error(old: str, new: str, where: str) -> None:
    text = MODEL.replace("UNIT", "kg")
    with pytest.raises(ConfigError) as caught:
        parse_text(text.replace(old, new), ModelConfig, "model")
    assert f"{where}: expected an SI unit without prefix" in str(caught.value)
