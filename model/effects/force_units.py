"""Derive the units of a model's generalised forces from its input matrix and the inputs' units."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

_OF_INERTIA = {("kg", "m"): "N", ("kg m^2", "rad"): "N m", ("kg", "mm"): "mN", ("kg", "um"): "uN"}
"""Unit of a force by those of an inertia and of its motion."""
_NAME = re.compile(r"-?\s*([A-Za-z_]\w*)")


def force_units(
    B: Sequence[Sequence[float | str]] | None,
    input_units: Sequence[str],
    parameter_units: Mapping[str, str],
    M: Sequence[Sequence[float | str]],
    dof_units: Sequence[str],
) -> tuple[str, ...]:
    """Return the unit of the force in each equation.

    A mass in kg of a DOF in m has a force in N, an inertia in kg m^2 of one in rad a torque in N m.
    Else it is B times an input, and the first input of an equation decides. An entry of B that is 1
    or -1 leaves the input's unit, one that is a parameter multiplies it: N/V times V is N. Another
    entry tells nothing: the unit is 1. Without B, each input acts on its own equation.
    """
    rows = len(dof_units)
    if B is None:
        B = np.eye(rows, len(input_units)).tolist()
    units = [_unit_of(row, input_units, parameter_units) for row in B]
    by_mass = [
        _OF_INERTIA.get((parameter_units.get(str(M[i][i]).strip(), ""), unit))
        for i, unit in enumerate(dof_units)
    ]
    return tuple(own or other for own, other in zip(by_mass, units, strict=True))


def unit_power(unit: str, power: int) -> str:
    """Return a unit to a power, in brackets if it has several factors: m^2, (N m)^2, (N m)."""
    single = unit if unit.isalpha() else f"({unit})"
    return single if power == 1 else f"{single}^{power}"


def per_unit(unit: str, power: int) -> str:
    """Return one over a unit to a power; of a number without a unit that is 1."""
    return "1" if unit == "1" else f"1/{unit_power(unit, power)}"


def ratio(unit: str, other: str) -> str:
    """Return the unit of a share of one quantity in another: m/rad, N/(N m), 1."""
    return "1" if unit == other else f"{unit}/{unit_power(other, 1)}"


def _unit_of(
    row: Sequence[float | str], input_units: Sequence[str], parameter_units: Mapping[str, str]
) -> str:
    for entry, unit in zip(row, input_units, strict=False):
        text = str(entry).strip()
        if _number(text) == 0.0:
            continue
        number = _number(text)
        if number is not None:
            return unit if abs(number) == 1.0 else "1"
        found = _NAME.fullmatch(text)
        if found is None or found[1] not in parameter_units:
            return "1"
        return _times(parameter_units[found[1]], unit)
    return "1"


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _times(gain: str, unit: str) -> str:
    """Return the product of a gain's unit and an input's, without what cancels."""
    if gain == "1":
        return unit
    if unit == "1":
        return gain
    for ending in (f"/{unit}", f"/({unit})"):
        if gain.endswith(ending):
            return gain.removesuffix(ending)
    return f"{gain} {unit}"
