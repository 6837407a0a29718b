"""PySINDy and SysIdentPy on one library of functions, the same forces, and nothing that remembers.

The library is static for both: products, |v| v and a smooth sign(v). SysIdentPy's lagged regressors
and PySINDy's derivatives would be memory, and what is put into the model here as a force law is a
function of the present row alone. Friction that remembers is beyond both for that reason, not for
one of theirs.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DEGREE = 3
_THRESHOLDS = np.geomspace(1e-3, 0.5, 10)
"""Of regressors of unit size, and forces of which the largest is."""
_RIDGE = 1e-8
_FOLDS = 5
_MOST_TERMS = 25
_SLOW = 0.1
"""Of a velocity's deviation: below it the smooth sign(v) is no sign yet."""


@dataclass(frozen=True)
class Library:
    """T functions of regressors over `scale` (R,), some of which are `velocities` (columns).

    First the products up to DEGREE, the constant before all; then |v| v of each velocity, then
    tanh(v / v_0), v_0 a tenth of its deviation.
    """

    scale: Array
    velocities: tuple[int, ...]

    @cached_property
    def powers(self) -> NDArray[np.int64]:
        """Powers (., R) of the products."""
        return powers_of(len(self.scale))

    def __len__(self) -> int:
        return len(self.powers) + 2 * len(self.velocities)

    def at(self, regressors: Array, some: Sequence[int] | None = None) -> Array:
        """Return the functions (N, T), or `some` of them, at regressors (N, R) in SI units."""
        which = np.arange(len(self)) if some is None else np.asarray(some, np.int64)
        x, count = regressors / self.scale, len(self.powers)
        v = x[:, self.velocities]
        laws = np.hstack([np.abs(v) * v, np.tanh(v / _SLOW)])
        return np.hstack(
            [products(x, self.powers[which[which < count]]), laws[:, which[which >= count] - count]]
        )


@dataclass(frozen=True)
class Sample:
    """Forces (N, n) over `size` (n,), and what they may be made of; each row's block of time.

    functions: for each DOF those of the library (N, T), through the filter that its force came
    through.
    """

    functions: tuple[Array, ...]
    force: Array
    library: Library
    size: Array
    block: NDArray[np.int64]


@dataclass(frozen=True)
class ForceLaw:
    """Force as a sum of functions of a library, coefficients (T, n)."""

    library: Library
    coefficients: Array

    @property
    def terms(self) -> int:
        """Number of functions that do anything, over all DOFs."""
        return int(np.count_nonzero(self.coefficients))

    def at(self, regressors: Array) -> Array:
        """Return the force (N, n) at regressors (N, R) in SI units."""
        used = np.flatnonzero(np.any(self.coefficients != 0.0, axis=1))
        return np.asarray(self.library.at(regressors, used) @ self.coefficients[used])


def powers_of(count: int) -> NDArray[np.int64]:
    """Return the powers (T, count) of all products up to DEGREE, the constant first."""
    chosen = (
        some for k in range(DEGREE + 1) for some in combinations_with_replacement(range(count), k)
    )
    return np.array([np.bincount(np.array(some, int), minlength=count) for some in chosen])


def products(x: Array, powers: NDArray[np.int64]) -> Array:
    """Return products (N, T) of powers (T, R) of x (N, R)."""
    out = np.ones((len(x), len(powers)))
    for t, i in zip(*np.nonzero(powers), strict=True):
        out[:, t] *= x[:, i] ** powers[t, i]
    return out


def pysindy(sample: Sample) -> ForceLaw:
    """Return a sparse sum by STLSQ (Brunton, Proctor and Kutz 2016), for each DOF."""
    import pysindy as ps

    out = sample.block % _FOLDS == 0

    def fitted(dof: int, threshold: float, rows: NDArray[np.bool_]) -> Array:
        optimizer = ps.STLSQ(threshold=threshold, alpha=_RIDGE)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a threshold that leaves nothing is no news
            optimizer.fit(sample.functions[dof][rows], sample.force[rows, dof : dof + 1])
        return np.asarray(optimizer.coef_, float).ravel()

    def error(threshold: float) -> float:
        left = [
            sample.force[out, i] - given[out] @ fitted(i, threshold, ~out)
            for i, given in enumerate(sample.functions)
        ]
        return float(np.mean(np.square(left)))

    best, every = min(_THRESHOLDS.tolist(), key=error), np.ones_like(out)
    found = np.column_stack([fitted(i, best, every) for i in range(len(sample.functions))])
    return ForceLaw(sample.library, found * sample.size)


def sysidentpy(sample: Sample) -> ForceLaw:
    """Return functions one by one by error reduction ratio (Billings 2013), for each DOF."""
    from sysidentpy.basis_function import Polynomial as Basis
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    found = np.zeros((len(sample.library), len(sample.size)))
    for i, given in enumerate(sample.functions):
        # A finite impulse response of one tap, x(k - 1): fed one row ahead, it is a static
        # function. The constant is the basis' own.
        ahead = np.vstack([given[1:, 1:], given[-1:, 1:]])
        model = FROLS(
            ylag=1, xlag=[[1]] * ahead.shape[1], model_type="NFIR", basis_function=Basis(degree=1),
            order_selection=True, info_criteria="bic", n_info_values=_MOST_TERMS,
            estimator=LeastSquares(),
        )  # fmt: skip
        model.fit(X=ahead, y=sample.force[:, [i]])
        for code, theta in zip(model.final_model, np.ravel(model.theta), strict=True):
            # 2001 is the first input a row before, 3001 the second; 0 stands for nothing.
            used = np.asarray(code, int)[np.asarray(code) > 0] // 1000 - 1
            found[used[0] if len(used) else 0, i] += float(theta) * sample.size[i]
    return ForceLaw(sample.library, found)


def load(who: str) -> None:
    """Import all of a peer, which takes a second; raises ModuleNotFoundError."""
    for name in _MODULES[who]:
        importlib.import_module(name)


PEERS: dict[str, Callable[[Sample], ForceLaw]] = {"PySINDy": pysindy, "SysIdentPy": sysidentpy}
_MODULES = {
    "PySINDy": ("pysindy",),
    "SysIdentPy": (
        "sysidentpy.basis_function",
        "sysidentpy.model_structure_selection",
        "sysidentpy.parameter_estimation",
    ),
}
