"""Test that forces have the unit of mass times acceleration, else that of B times a command."""

from __future__ import annotations

import pytest

from levid.model.effects.force_units import force_units

UNITS = {"m": "kg", "J": "kg m^2", "k_t": "N m/A", "gain": "N/V", "tau": "s"}


@pytest.mark.parametrize(
    ("B", "inputs", "M", "dof", "force"),
    [
        # 52 N/A as a number: the force is no current.
        ([[52.0]], ["A"], [["m"]], ["m"], ["N"]),
        ([["k_t"]], ["A"], [["J"]], ["rad"], ["N m"]),
        # No input acts on the cart.
        ([[1.0], [0.0]], ["N"], [["m", 0.0], [0.0, "m"]], ["m", "m"], ["N", "N"]),
        # The mass is a number: the input's unit times B's.
        ([["gain"]], ["V"], [[2.0]], ["m"], ["N"]),
        ([[-1.0]], ["N"], [[2.0]], ["m"], ["N"]),
        ([[3.0]], ["V"], [[2.0]], ["m"], ["1"]),
        (None, ["N"], [[2.0]], ["m"], ["N"]),
    ],
)
def test_unit_of_each_equation(B, inputs, M, dof, force) -> None:
    assert force_units(B, inputs, UNITS, M, dof) == tuple(force)
