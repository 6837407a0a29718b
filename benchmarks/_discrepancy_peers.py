"""PySINDy and SysIdentPy as they are meant to be used, on the same products and forces."""

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
"""Of regressors of unit size, and forces of which the largest is."""
_RIDGE = 1e-8
_FOLDS = 5
_MOST_TERMS = 25


@dataclass(frozen=True)
class Sample:
    """Forces (N, n) over `size`, and what they may be made of; each row's block of time.

    products: of each DOF (N, T), of powers (T, R) of regressors over `scale` (R,), through the
    filter that its force came through.
    """

    products: tuple[Array, ...]
    force: Array
    powers: NDArray[np.int64]
    scale: Array
    size: Array
    block: NDArray[np.int64]


@dataclass(frozen=True)
class Polynomial:
    """Force as a sum of products: powers (T, R) of regressors over `scale`, coefficients (T, n)."""

    powers: NDArray[np.int64]
    coefficients: Array
    scale: Array

    @property
    def terms(self) -> int:
        """Number of products that do anything, over all DOFs."""
        return int(np.count_nonzero(self.coefficients))

    def at(self, regressors: Array) -> Array:
        """Return the force (N, n) at regressors (N, R) in SI units."""
        used = np.any(self.coefficients != 0.0, axis=1)
        return products(regressors / self.scale, self.powers[used]) @ self.coefficients[used]


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


def pysindy(sample: Sample) -> Polynomial:
    """Return sparse products by STLSQ (Brunton, Proctor and Kutz 2016), for each DOF."""
    import pysindy as ps

    out = sample.block % _FOLDS == 0

    def fitted(dof: int, threshold: float, rows: NDArray[np.bool_]) -> Array:
        optimizer = ps.STLSQ(threshold=threshold, alpha=_RIDGE)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a threshold that leaves nothing is no news
            optimizer.fit(sample.products[dof][rows], sample.force[rows, dof : dof + 1])
        return np.asarray(optimizer.coef_, float).ravel()

    def error(threshold: float) -> float:
        left = [
            sample.force[out, i] - p[out] @ fitted(i, threshold, ~out)
            for i, p in enumerate(sample.products)
        ]
        return float(np.mean(np.square(left)))

    best, every = min(_THRESHOLDS.tolist(), key=error), np.ones_like(out)
    found = np.column_stack([fitted(i, best, every) for i in range(len(sample.products))])
    return Polynomial(sample.powers, found * sample.size, sample.scale)


def sysidentpy(sample: Sample) -> Polynomial:
    """Return products one by one by error reduction ratio (Billings 2013), for each DOF."""
    from sysidentpy.basis_function import Polynomial as Basis
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    found = np.zeros((len(sample.powers), len(sample.size)))
    for i, given in enumerate(sample.products):
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
    return Polynomial(sample.powers, found, sample.scale)


PEERS: dict[str, Callable[[Sample], Polynomial]] = {"PySINDy": pysindy, "SysIdentPy": sysidentpy}
