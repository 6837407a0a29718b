"""Fit a force law with PySINDy or SysIdentPy, both from one library of static functions.

The library has products, |v| v and a smooth sign(v). Lagged regressors (SysIdentPy) and derivatives
(PySINDy) are left out: the law that is put into the model is a function of the present row.
Friction with memory is out of reach of both for this reason.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DEGREE = 3
_THRESHOLDS = np.geomspace(1e-3, 0.5, 10)
"""For regressors of unit size, and forces of which the largest has unit size."""
_RIDGE = 1e-8
_FOLDS = 5
_MOST_TERMS = 25
_SLOW = 0.1
"""Of a velocity's deviation: where the smooth sign(v) saturates."""


@dataclass(frozen=True)
class Library:
    """T functions of regressors over `scale` (R,); `velocities` are some of their columns.

    First the products up to DEGREE, the constant before all; then |v| v of each velocity, then
    tanh(v / v_0), v_0 a tenth of its deviation.
    """

    scale: Array
    velocities: tuple[int, ...]

    def at(self, regressors: Array) -> Array:
        """Return the functions (N, T) at regressors (N, R) in SI units."""
        x = regressors / self.scale
        v = x[:, self.velocities]
        columns = range(len(self.scale))
        chosen = (combinations_with_replacement(columns, k) for k in range(DEGREE + 1))
        products = [x[:, list(some)].prod(axis=1) for of_degree in chosen for some in of_degree]
        return np.column_stack([*products, np.abs(v) * v, np.tanh(v / _SLOW)])


@dataclass(frozen=True)
class Sample:
    """Forces (N, n) over `size` (n,), the functions they may consist of, each row's time block.

    functions: for each DOF those of the library (N, T), through the filter of its force.
    """

    functions: tuple[Array, ...]
    force: Array
    library: Library
    size: Array
    block: NDArray[np.int64]


@dataclass(frozen=True)
class ForceLaw:
    """A force as a sum of functions of a library, coefficients (T, n)."""

    library: Library
    coefficients: Array

    @property
    def terms(self) -> int:
        """Number of nonzero coefficients, over all DOFs."""
        return int(np.count_nonzero(self.coefficients))

    def at(self, regressors: Array) -> Array:
        """Return the force (N, n) at regressors (N, R) in SI units."""
        return np.asarray(self.library.at(regressors) @ self.coefficients)


def pysindy(sample: Sample) -> ForceLaw:
    """Return a sparse sum by STLSQ (Brunton, Proctor and Kutz 2016) for each DOF.

    The threshold is the one of least error on a fifth of the blocks.
    """
    import pysindy as ps

    held_out = sample.block % _FOLDS == 0

    def fitted(threshold: float, rows: NDArray[np.bool_]) -> Array:
        found = []
        for given, force in zip(sample.functions, sample.force.T, strict=True):
            optimizer = ps.STLSQ(threshold=threshold, alpha=_RIDGE)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a threshold that removes all terms
                optimizer.fit(given[rows], force[rows, None])
            found.append(np.asarray(optimizer.coef_, float).ravel())
        return np.column_stack(found)

    def error(threshold: float) -> float:
        law = fitted(threshold, ~held_out)
        fits = [given[held_out] @ one for given, one in zip(sample.functions, law.T, strict=True)]
        return float(np.mean(np.square(sample.force[held_out] - np.column_stack(fits))))

    best = min(_THRESHOLDS.tolist(), key=error)
    return ForceLaw(sample.library, fitted(best, np.ones_like(held_out)) * sample.size)


def sysidentpy(sample: Sample) -> ForceLaw:
    """Return functions one by one by error reduction ratio (FROLS, Billings 2013) for each DOF.

    Their number is by BIC.
    """
    from sysidentpy.basis_function import Polynomial as Basis
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    found = np.zeros((sample.functions[0].shape[1], len(sample.size)))
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
            # 2001 is the first input a row before, 3001 the second; 0 is an empty factor.
            used = np.asarray(code, int)[np.asarray(code) > 0] // 1000 - 1
            found[used[0] if len(used) else 0, i] += float(theta) * sample.size[i]
    return ForceLaw(sample.library, found)


PEERS: dict[str, Callable[[Sample], ForceLaw]] = {"PySINDy": pysindy, "SysIdentPy": sysidentpy}
