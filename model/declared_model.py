"""Evaluate a declared model M(p) q'' + D(p) q' + K(p) q = B(p) u + f(p) with any number of DOF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .expression import Expression, ExpressionError

if TYPE_CHECKING:
    from .second_order import SecondOrder

Array = NDArray[np.float64]
Grid = tuple[tuple[Expression, ...], ...]


_SINGULAR = 1e12
"""Largest M[i, j] inv(M)[j, i] of a regular mass matrix; above it the inverse is rounding error."""


class ModelError(ValueError):
    """A declared model is inconsistent: a size, a name, a formula or a value does not fit."""


@dataclass(frozen=True)
class Matrices:
    """M, D, K (N, n, n), B (N, n, p) and force (N, n) along a record, in SI units."""

    M: Array
    D: Array
    K: Array
    B: Array
    force: Array


class Change(NamedTuple):
    """Change of a matrix entry by a parameter: row, column, and the change, a scalar or (N,)."""

    row: int
    column: int
    change: Array


@dataclass(frozen=True)
class DeclaredModel:
    """Matrices as formulas in parameters and scheduling variables.

    `values` and `scheduling` are in SI units. `force` is f, the force that does not depend on the
    inputs (gravity and reaction of the beam). `lag` and `delay` are the first-order lag and the
    delay in s between a commanded and an acting input.
    """

    dof: tuple[str, ...]
    inputs: tuple[str, ...]
    values: Mapping[str, float]
    scheduling: Mapping[str, float]
    M: Grid
    D: Grid
    K: Grid
    B: Grid
    force: tuple[Expression, ...]
    lag: Expression = field(default_factory=lambda: Expression.parse(0))
    delay: Expression = field(default_factory=lambda: Expression.parse(0))

    @classmethod
    def build(
        cls,
        dof: Sequence[str],
        inputs: Sequence[str],
        values: Mapping[str, float],
        scheduling: Mapping[str, float],
        matrices: Mapping[str, Sequence[Sequence[str | float]]],
        force: Sequence[str | float] = (),
        lag: str | float = 0.0,
        delay: str | float = 0.0,
    ) -> DeclaredModel:
        """Parse formulas and check that sizes and names agree.

        Raises:
            ModelError: a matrix of the wrong size, an undeclared name, an invalid formula, a lag
                below 0 or without a value; the message names the matrix and the entry.
        """
        n, p = len(dof), len(inputs)
        known = set(values) | set(scheduling)
        B = matrices.get("B")
        if B is None and n != p:
            raise ModelError(f"B: required matrix is missing: the model has {p} inputs and {n} DOF")
        if B is None:
            B = [[float(i == j) for j in range(n)] for i in range(n)]
        grids = {
            name: _grid(name, rows, n, columns, known)
            for name, rows, columns in (
                ("M", matrices["M"], n),
                ("D", matrices["D"], n),
                ("K", matrices["K"], n),
                ("B", B, p),
            )
        }
        if force and len(force) != n:
            raise ModelError(f"force: expected {n} entries, one a DOF, found {len(force)}")
        model = cls(
            tuple(dof),
            tuple(inputs),
            dict(values),
            dict(scheduling),
            **grids,
            force=tuple(_formula("force", f, known) for f in force or [0.0] * n),
            lag=_formula("lag", lag, known),
            delay=_formula("delay", delay, known),
        )
        # A negative lag is not causal. A delay may be negative: every backend adds one cycle.
        try:
            lag_s = model.lag({**model.values, **model.scheduling})
        except ExpressionError as error:
            raise ModelError(f"lag: {error}") from None
        if lag_s < 0.0:
            raise ModelError(
                f"lag: expected 0 s or more, found {lag_s:g} s from '{model.lag.text}'"
            )
        return model

    @property
    def lagging(self) -> bool:
        """Whether the force of the inputs follows them with a lag, known or to be found."""
        return bool(self.lag.names) or self.lag({}) > 0.0

    def at(self, scheduling: Mapping[str, float] | None = None) -> SecondOrder:
        """Return the matrices at one value of the scheduling variables (default: as declared).

        Raises:
            ModelError: an unknown variable, a formula without a value, a singular M.
        """
        return self._at(scheduling) if scheduling else self._as_declared

    @cached_property
    def _as_declared(self) -> SecondOrder:
        return self._at({})

    def _at(self, scheduling: Mapping[str, float]) -> SecondOrder:
        # Imported here because scipy.linalg takes 0.5 s to load and the daemon does not need it.
        from .second_order import SecondOrder

        unknown = set(scheduling) - set(self.scheduling)
        if unknown:
            raise ModelError(
                f"expected scheduling variables {sorted(self.scheduling)}, found {sorted(unknown)}"
            )
        values = {**self.values, **self.scheduling, **scheduling}
        try:
            M = _evaluate(self.M, values)
            inverse_mass(M[None], {name: np.array([values[name]]) for name in self.scheduling})
            return SecondOrder(
                M=M,
                D=_evaluate(self.D, values),
                K=_evaluate(self.K, values),
                B=_evaluate(self.B, values),
                force=np.array([f(values) for f in self.force]),
                lag_s=self.lag(values),
                delay_s=self.delay(values),
            )
        except ExpressionError as error:
            raise ModelError(str(error)) from None

    def over(self, scheduling: Mapping[str, Array]) -> Matrices:
        """Return the matrices for scheduling variables (N,); variables not given are as declared.

        Raises:
            ModelError: a formula without a value.
        """
        grids = (self.M, self.D, self.K, self.B, (self.force,))
        M, D, K, B, force = (self._along(grid, scheduling) for grid in grids)
        return Matrices(M, D, K, B, force[:, 0])

    def moving_force(self, scheduling: Mapping[str, Array]) -> Array:
        """Return the force f (N, n) for scheduling variables (N,), 0 where its formula is constant.

        A constant force (a weight) is part of each record's unknown offset. Raises ModelError.
        """
        force = self._along((self.force,), scheduling)[:, 0]
        force[:, [not formula.names & set(self.scheduling) for formula in self.force]] = 0.0
        return force

    def changes(
        self, name: str, below: float, above: float, scheduling: Mapping[str, Array]
    ) -> dict[str, list[Change]]:
        """Return how M, D, K, B and force change with a parameter, entries that do not left out.

        `above` less `below` are values of the parameter; scheduling variables (N,) that are not
        given are as declared. Raises ModelError.
        """
        values: dict[str, float | Array] = {**self.values, **self.scheduling, **scheduling}
        low, high = ({**values, name: value} for value in (below, above))
        grids = {"M": self.M, "D": self.D, "K": self.K, "B": self.B, "force": (self.force,)}
        try:
            return {
                key: [
                    Change(i, j, entry.over(high) - entry.over(low))
                    for i, row in enumerate(grid)
                    for j, entry in enumerate(row)
                    if name in entry.names
                ]
                for key, grid in grids.items()
            }
        except ExpressionError as error:
            raise ModelError(str(error)) from None

    def _along(self, grid: Grid, scheduling: Mapping[str, Array]) -> Array:
        values: dict[str, float | Array] = {**self.values, **self.scheduling, **scheduling}
        n = len(next(iter(scheduling.values()))) if scheduling else 1
        try:
            return _stacked(grid, values, n)
        except ExpressionError as error:
            raise ModelError(str(error)) from None

    def with_values(self, values: Mapping[str, float]) -> DeclaredModel:
        """Return the model with some parameters changed; raises ModelError for unknown names."""
        unknown = set(values) - set(self.values)
        if unknown:
            raise ModelError(f"expected parameters {sorted(self.values)}, found {sorted(unknown)}")
        return replace(self, values={**self.values, **values})


def inverse_mass(M: Array, scheduling: Mapping[str, Array]) -> Array:
    """Return the inverses (R, n, n) of mass matrices at R values of scheduling variables (R,).

    Raises:
        ModelError: a matrix is singular; the message has the matrix and the scheduling variables.
    """
    try:
        inverse = np.asarray(np.linalg.inv(M), np.float64)
        # These products do not depend on units and are small for a regular matrix.
        singular = ~(np.abs(M * inverse.swapaxes(1, 2)).max(axis=(1, 2)) < _SINGULAR)
    except np.linalg.LinAlgError:
        inverse, singular = np.zeros_like(M), np.linalg.det(M) == 0.0
    if not singular.any():
        return inverse
    row = int(np.argmax(singular))
    at = ", ".join(f"{name} = {values[row]:g}" for name, values in scheduling.items())
    raise ModelError(
        f"M: expected a mass matrix that has an inverse, found {M[row].tolist()}"
        + (f" at {at}" if at else "")
    )


def _grid(
    name: str, rows: Sequence[Sequence[str | float]], n: int, columns: int, known: set[str]
) -> Grid:
    if len(rows) != n or any(len(row) != columns for row in rows):
        found = f"{len(rows)} rows of {sorted({len(row) for row in rows})}"
        raise ModelError(f"{name}: expected {n} rows of {columns} entries, found {found}")
    return tuple(
        tuple(_formula(f"{name}[{i}][{j}]", entry, known) for j, entry in enumerate(row))
        for i, row in enumerate(rows)
    )


def _formula(where: str, source: str | float, known: set[str]) -> Expression:
    try:
        expression = Expression.parse(source)
    except ExpressionError as error:
        raise ModelError(f"{where}: {error}") from None
    unknown = expression.names - known
    if unknown:
        raise ModelError(
            f"{where}: expected declared parameters and scheduling variables, "
            f"found {sorted(unknown)} in '{expression.text}'"
        )
    return expression


def _stacked(grid: Grid, values: Mapping[str, float | Array], n: int) -> Array:
    stacked = np.empty((n, len(grid), len(grid[0])))
    for i, row in enumerate(grid):
        for j, entry in enumerate(row):
            stacked[:, i, j] = entry.over(values)
    return stacked


def _evaluate(grid: Grid, values: Mapping[str, float]) -> NDArray[np.float64]:
    return np.array([[entry(values) for entry in row] for row in grid])
