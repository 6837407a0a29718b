"""PySINDy and SysIdentPy as they are meant to be used, on the same regressors and forces."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

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
    """Regressors (N, R) over `scale`, forces (N, n) over `size`, and each row's block of time."""

    regressors: Array
    force: Array
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
        x = regressors / self.scale
        columns = [
            np.prod([x[:, i] ** p for i, p in enumerate(powers) if p] or [np.ones(len(x))], axis=0)
            for powers in self.powers[used]
        ]
        if not columns:
            return np.zeros((len(x), self.coefficients.shape[1]))
        return np.asarray(np.column_stack(columns) @ self.coefficients[used])


def pysindy(sample: Sample) -> Polynomial:
    """Return sparse products by STLSQ (Brunton, Proctor and Kutz 2016)."""
    import pysindy as ps

    library = ps.PolynomialLibrary(degree=DEGREE)
    out = sample.block % _FOLDS == 0

    def fitted(threshold: float, rows: NDArray[np.bool_]) -> ps.SINDy:
        optimizer = ps.STLSQ(threshold=threshold, alpha=_RIDGE)
        model = ps.SINDy(optimizer=optimizer, feature_library=library)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a threshold that leaves nothing is no news
            return model.fit(sample.regressors[rows], t=1.0, x_dot=sample.force[rows])

    def error(threshold: float) -> float:
        predicted = fitted(threshold, ~out).predict(sample.regressors[out])
        return float(np.mean((sample.force[out] - predicted) ** 2))

    model = fitted(min(_THRESHOLDS.tolist(), key=error), np.ones_like(out))
    powers = np.asarray(model.feature_library.powers_, int)
    return Polynomial(powers, model.coefficients().T * sample.size, sample.scale)


def sysidentpy(sample: Sample) -> Polynomial:
    """Return products one by one by error reduction ratio (Billings 2013), for each DOF."""
    from sysidentpy.basis_function import Polynomial as Basis
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    count, n = sample.regressors.shape[1], sample.force.shape[1]
    # A finite impulse response of one tap, x(k - 1): fed one row ahead, it is a static function.
    ahead = np.vstack([sample.regressors[1:], sample.regressors[-1:]])
    powers: list[NDArray[np.int64]] = []
    rows: list[Array] = []
    for i in range(n):
        model = FROLS(
            ylag=1, xlag=[[1]] * count, model_type="NFIR", basis_function=Basis(degree=DEGREE),
            order_selection=True, info_criteria="bic", n_info_values=_MOST_TERMS,
            estimator=LeastSquares(),
        )  # fmt: skip
        model.fit(X=ahead, y=sample.force[:, [i]])
        for code, theta in zip(model.final_model, np.ravel(model.theta), strict=True):
            # 2001 is the first input a row before, 3001 the second; 0 stands for nothing.
            used = np.asarray(code, int)[np.asarray(code) > 0] // 1000 - 2
            powers.append(np.bincount(used, minlength=count))
            rows.append(np.eye(n)[i] * float(theta) * sample.size[i])
    return Polynomial(np.array(powers), np.array(rows), sample.scale)


PEERS: dict[str, Callable[[Sample], Polynomial]] = {"PySINDy": pysindy, "SysIdentPy": sysidentpy}
