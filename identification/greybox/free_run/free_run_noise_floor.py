"""Compute the noise floor: the free-run error of a perfect model, as covariance and spectrum.

This error obeys the model's equations in the record's loop, driven by noise alone. Its covariance
is computed exactly from row to row, without random draws.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ....model.declared_model import DeclaredModel
from ..experiment.experiment_from_log import Experiment
from ..experiment.intersample_input import HeldStep, Hold
from ..prediction.discretisation import Motion, motion, process_covariance
from ..prediction.noise_model import Noise
from .free_run_simulation import first_row, input_step

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_BLOCKS = 1024
"""Least number of blocks of a record; the covariance hardly changes within one."""
_LINES = 8192
"""Frequencies of an integrated spectrum, 0.15 % apart over five decades."""
_PLACES = 8
"""Points in time over which the spectrum of a moving schedule is averaged."""
_LARGEST_SPREAD = np.sqrt(0.5)
"""Relative standard deviation of the rms of a single value, the upper limit."""


@dataclass(frozen=True)
class NoiseFloor:
    """The free-run error of a perfect model on the rows compared, in output units.

    rms (n,): expected rms error. motion (n, n): the part of the error covariance that is motion;
    the rest is measurement noise, independent of the motion of the same row. spread (n,): standard
    deviation of one record's rms, relative to `rms`.
    """

    rms: Array
    motion: Array
    spread: Array


def floor_rms(model: DeclaredModel, experiment: Experiment, hold: Hold, noise: Noise) -> Array:
    """Return only NoiseFloor.rms (n,)."""
    return _rms(motion_covariance(model, experiment, hold, noise), noise)


def motion_covariance(
    model: DeclaredModel, experiment: Experiment, hold: Hold, noise: Noise
) -> Array:
    """Return only NoiseFloor.motion (n, n): the mean over the rows compared."""
    n = experiment.y.shape[1]
    counted = experiment.rows(first_row(experiment), len(experiment.y))
    # Blocks of 2^d rows: A^(2^d) by squaring; the covariance advances block by block.
    doublings = max(int(np.log2(len(counted.y) / _BLOCKS)), 0) if len(counted.y) > _BLOCKS else 0
    at = _thinned(model, counted, hold, 2**doublings)
    A, W = _error_system(model, counted, at, noise)
    for _ in range(doublings):
        W = W + A @ W @ np.swapaxes(A, 1, 2)
        A = A @ A
    blocks = len(counted.y) // 2**doublings
    P, total = np.zeros_like(W[0]), np.zeros((n, n))
    for k in range(blocks):
        row = min(k, len(A) - 1)
        after = A[row] @ P @ A[row].T + W[row]
        total += P[:n, :n] if doublings == 0 else 0.5 * (P[:n, :n] + after[:n, :n])
        P = after
    return np.asarray(total / max(blocks, 1))


def noise_floor(
    model: DeclaredModel, experiment: Experiment, hold: Hold, noise: Noise
) -> NoiseFloor:
    """Compute the noise floor of a perfect `model` on the rows that free_run compares.

    The noise is that of `predict`: white generalised forces and white measurement noise, which also
    enters the controller. The state at the first row compared is assumed known. Along a moving
    schedule each row has its own matrices. The spread follows from the spectrum:
    var(rms^2) = integral of S(f)^2 df / T for a one-sided S (Bendat and Piersol 2010, 8.2).
    """
    covariance = motion_covariance(model, experiment, hold, noise)
    duration_s = (len(experiment.y) - first_row(experiment)) * experiment.Ts_s
    freq_hz = np.geomspace(0.5 / duration_s, 0.5 / experiment.Ts_s, _LINES)
    psd = _spectra(model, experiment, hold, noise, freq_hz)
    # A record along a schedule is treated as a series of short records.
    power = np.trapezoid(psd, freq_hz, axis=1).mean(axis=0)
    square = np.trapezoid(psd**2, freq_hz, axis=1).mean(axis=0) / duration_s
    spread = np.minimum(0.5 * np.sqrt(square) / power, _LARGEST_SPREAD)
    return NoiseFloor(_rms(covariance, noise), covariance, spread)


def floor_psd(
    model: DeclaredModel, experiment: Experiment, hold: Hold, noise: Noise, freq_hz: Array
) -> Array:
    """Return the expected one-sided spectrum (F, n) of the floor by Welch's method, Hann windows.

    freq_hz (F,) is evenly spaced from 0 on; the window smears narrow peaks.
    """
    step_hz = float(freq_hz[1] - freq_hz[0]) if len(freq_hz) > 1 else 1.0
    offsets = np.array([-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5])
    # The power of a Hann window at offsets in lines: (sinc(x) / (1 - x^2))^2, 1/4 at x = 1.
    beside = np.abs(offsets) == 1.0
    safe = np.where(beside, 0.0, offsets)
    weights = np.where(beside, 0.25, (np.sinc(safe) / (1 - safe**2)) ** 2)
    half = np.arange(-3, 2 * len(freq_hz) + 2)
    fine = np.abs(freq_hz[0] + 0.5 * step_hz * half)
    fine = np.maximum(fine, 1e-3 * step_hz)  # an integrating controller is infinite at 0 Hz
    psd = _spectra(model, experiment, hold, noise, fine).mean(axis=0)
    smeared = [weights @ psd[2 * k : 2 * k + 7] / weights.sum() for k in range(len(freq_hz))]
    return np.array(smeared)


def powers_of(response: Complex, covariance: Array) -> Array:
    """Return the output powers (F, n) of responses (F, n, s) to inputs with covariance (s, s)."""
    return np.asarray(np.einsum("fia,ab,fib->fi", response, covariance, response.conj()).real)


def _rms(covariance: Array, noise: Noise) -> Array:
    return np.asarray(np.sqrt(np.diag(covariance) + noise.output_variance))


def _thinned(model: DeclaredModel, experiment: Experiment, hold: Hold, step: int) -> Motion:
    """Return the matrices in the middle of every `step` rows; inputs and drift are not valid."""
    thin = replace(
        experiment,
        u=np.zeros_like(experiment.u[::step]),
        y=experiment.y[::step],
        schedule={name: values[::step] for name, values in experiment.schedule.items()},
    )
    return motion(model, thin, hold)


def _error_system(
    model: DeclaredModel, experiment: Experiment, at: Motion, noise: Noise
) -> tuple[Array, Array]:
    """Return A and W (R, s, s) of the error's equation e(k+1) = A e(k) + w(k), cov w = W.

    States: [q, q'], and in closed loop the lagged input, the controller's states, and the commands
    of the last `whole` + 1 periods.
    """
    Q = process_covariance(at, noise.force_density)
    Phi, powers = _flow(at)
    if experiment.loop is None:
        return Phi, Q
    controller = experiment.loop.controller
    step = input_step(model, experiment, at)
    R, n, p = len(Phi), at.K.shape[1], at.B.shape[2]
    lag, state, before = 2 * n, 2 * n + p, 2 * n + p + len(controller.A)
    size = before + (step.whole + 1) * p
    # u(k) = C x + feedback (q + noise), by states and by noise.
    B_c, feedback = controller.by_output
    command = np.zeros((p, size))
    command[:, :n], command[:, state:before] = feedback, controller.C
    acting = [command] + [np.eye(size)[before + i * p :][:p] for i in range(step.whole + 1)]
    new, old = acting[step.whole], acting[step.whole + 1]
    lagged = np.eye(size)[lag:state]

    A, by_noise = np.zeros((R, size, size)), np.zeros((R, size, n))
    G_old, G_new, G_lag = (powers @ c for c in (step.from_old, step.from_new, step.from_lag))
    A[:, : 2 * n, : 2 * n] = Phi
    A[:, : 2 * n] += G_old @ old + G_new @ new + G_lag @ lagged
    A[:, lag:state] = step.end_old * old + step.end_new * new + step.end_lag * lagged
    A[:, state:before, :n] = B_c
    A[:, state:before, state:before] = controller.A
    A[:, before : before + p] = command
    A[:, before + p :, before:-p] = np.eye(step.whole * p)
    by_noise[:, state:before] = B_c
    by_noise[:, before : before + p] = feedback
    if step.whole == 0:
        by_noise[:, : 2 * n] = G_new @ feedback
        by_noise[:, lag:state] = step.end_new * feedback
    W = by_noise @ noise.output_covariance @ np.swapaxes(by_noise, 1, 2)
    W[:, : 2 * n, : 2 * n] += Q
    return A, W


def _spectra(
    model: DeclaredModel, experiment: Experiment, hold: Hold, noise: Noise, freq_hz: Array
) -> Array:
    """Return the one-sided spectra (R, F, n) of the error by noise, at R points in time."""
    counted = experiment.rows(first_row(experiment), len(experiment.y))
    at = _thinned(model, counted, hold, max(len(counted.y) // _PLACES, 1))
    Q, (Phi, powers) = process_covariance(at, noise.force_density), _flow(at)
    n = at.K.shape[1]
    psd = np.empty((len(Phi), len(freq_hz), n))
    z = np.exp(2j * np.pi * freq_hz * at.Ts_s)[:, None, None]
    for row in range(len(Phi)):
        free = np.asarray(np.linalg.inv(z * np.eye(2 * n) - Phi[row])[:, :n])
        by_force = free
        sensitivity = np.tile(np.eye(n, dtype=np.complex128), (len(z), 1, 1))
        if counted.loop is not None:
            step = input_step(model, counted, at)
            C = counted.loop.controller.response(freq_hz)
            inputs = _input_effect(powers[row], step, z)
            sensitivity = np.asarray(np.linalg.inv(np.eye(n) + (free @ inputs) @ C))
            by_force = np.asarray(sensitivity @ free)
        motion_psd = powers_of(by_force, Q[row])
        noise_psd = powers_of(sensitivity, noise.output_covariance)
        psd[row] = 2 * at.Ts_s * (motion_psd + noise_psd)
    return psd


def _input_effect(powers: Array, step: HeldStep, z: Complex) -> Complex:
    """Return the transfer (F, 2n, p) from a command to the change of the state over a period."""
    old, new = z ** -(step.whole + 1.0), z ** -float(step.whole)
    lagged = (step.end_old * old + step.end_new * new) / (z - step.end_lag)
    by_old, by_new, by_lag = (powers @ c for c in (step.from_old, step.from_new, step.from_lag))
    return np.asarray(by_old * old + by_new * new + by_lag * lagged)


def _flow(at: Motion) -> tuple[Array, Array]:
    """Return Phi (R, 2n, 2n) of a period, and A^j B (R, 2n, p, J) for the moments of the input."""
    R, n, p, order = len(at.K), at.K.shape[1], at.B.shape[2], len(at.scale) - 1
    A = np.zeros((R, 2 * n, 2 * n))
    A[:, :n, n:] = np.eye(n)
    A[:, n:, :n], A[:, n:, n:] = -at.K, -at.D
    Phi = np.tile(np.eye(2 * n), (R, 1, 1))
    power, by_input = Phi, np.zeros((R, 2 * n, p))
    by_input[:, n:] = at.B
    powers = np.empty((R, 2 * n, p, order))
    for j in range(order):
        powers[..., j] = by_input
        by_input = A @ by_input
        power = A @ power
        Phi = Phi + at.scale[j + 1] * power
    return Phi, powers
