"""Generate orthogonal random-phase multisines: excite several inputs at once, separably."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from ...config.session import Excitation, Orthogonal
from .excitation import excited_lines, one_period

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_GRID, _PHASES = 1, 2  # random streams: lines per session, phases per record


def orthogonal_multisines(
    excitations: Sequence[Excitation],
    plan: Orthogonal,
    rate_hz: float,
    seed: int,
    record: int,
) -> Iterator[Array]:
    """Yield periods (n, p) of p excitations in N m or N, without fading.

    Each realisation has p experiments of `plan.periods` periods; the last period goes on without
    end, which the fading at the end of a record needs. All records of a session have the same
    lines, drawn with `seed`; phases are drawn for each `record` and realisation.

    At each line, the spectra of the p experiments of a realisation form a unitary matrix up to the
    levels: V[j, e] = A_j W[e, j] exp(i phi_j) exp(i psi_e) with W from `orthogonal_matrix`
    (Dobrowiecki and Schoukens 2007). Since psi is random like phi ("full random orthogonal phases",
    Pintelon and Schoukens 2012, 3.7), the nonlinear distortions of the experiments are uncorrelated
    and affect all inputs equally, as noise does.

    Raises ConfigError if the band contains no line.
    """
    p = len(excitations)
    lines = excited_lines(excitations[0], rate_hz, np.random.default_rng([seed, _GRID]))
    W = orthogonal_matrix(p)
    for realisation in range(plan.realisations):
        rng = np.random.default_rng([seed, _PHASES, record, realisation])
        of_input, of_experiment = np.exp(2j * np.pi * rng.random((2, p, len(lines))))
        for e in range(p):
            period = np.stack(
                [
                    one_period(excitation, lines, W[e, j] * of_input[j] * of_experiment[e], rate_hz)
                    for j, excitation in enumerate(excitations)
                ],
                axis=1,
            )
            yield from repeat(period, plan.periods)
    yield from repeat(period)


def orthogonal_cycles(
    excitation: Excitation, inputs: int, plan: Orthogonal, fade_s: float, rate_hz: float
) -> int:
    """Return the number of samples of `orthogonal_multisines` for `inputs` inputs."""
    assert excitation.period_s is not None
    n = round(excitation.period_s * rate_hz)
    return plan.realisations * inputs * plan.periods * n + round(fade_s * rate_hz)


def orthogonal_matrix(p: int) -> Complex:
    """Return W (p, p), |W| = 1, W W^H = p I: Hadamard for powers of two, otherwise DFT matrix."""
    if p & (p - 1) == 0:
        W: Complex = np.ones((1, 1), dtype=np.complex128)
        while len(W) < p:  # as scipy.linalg.hadamard, whose import takes half of a planner's start
            W = np.block([[W, W], [W, -W]])
        return W
    k = np.arange(p)
    return np.asarray(np.exp(-2j * np.pi * np.outer(k, k) / p))
