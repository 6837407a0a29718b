"""Simulate identified models, predict one step ahead, and estimate initial states."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...model.second_order import StateSpace
from ..nonparametric.block_qr import BLOCK_ROWS, triangle
from ..records.record import Record

Array = NDArray[np.float64]

BLOCK = 64
"""Samples simulated in one matrix product; the state passes from block to block."""


@dataclass(frozen=True)
class InnovationModel:
    """x(k+1) = A x + B u + K e, y = C x + D u + e: a model with its steady-state predictor.

    `model` holds A, B, C, D; K is (n, m), e the one-step prediction error, `e_covariance` (m, m).
    """

    model: StateSpace
    K: Array
    e_covariance: Array

    def predictor(self) -> StateSpace:
        """Return the model from [u, y] to the one-step prediction of y."""
        m = self.model
        zeros = np.zeros((len(m.C), len(m.C)))
        return StateSpace(
            m.A - self.K @ m.C,
            np.hstack([m.B - self.K @ m.D, self.K]),
            m.C,
            np.hstack([m.D, zeros]),
            m.Ts_s,
        )


def simulate(model: StateSpace, u: Array, x0: Array | None = None) -> Array:
    """Return the response (N, m) to u (N, p) from state x0 (n,), zero unless given."""
    return Simulation(model, x0).respond(u)


class Simulation:
    """A model whose response to consecutive pieces of an input continues from piece to piece."""

    def __init__(self, model: StateSpace, x0: Array | None = None) -> None:
        n = len(model.A)
        m, p = model.D.shape
        # Powers of A: the effect of a block's initial state and inputs within and after the block.
        powers = np.empty((BLOCK + 1, n, n))
        powers[0] = np.eye(n)
        for k in range(BLOCK):
            powers[k + 1] = model.A @ powers[k]
        self._observe = (model.C @ powers[:BLOCK]).reshape(BLOCK * m, n)
        impulse = np.concatenate([model.D[None], model.C @ powers[: BLOCK - 1] @ model.B])
        within = np.zeros((BLOCK, m, BLOCK, p))
        for k in range(BLOCK):
            within[k, :, : k + 1] = impulse[k::-1].transpose(1, 0, 2)
        self._within = within.reshape(BLOCK * m, BLOCK * p)
        self._reach = (powers[BLOCK - 1 :: -1] @ model.B).transpose(1, 0, 2).reshape(n, BLOCK * p)
        self._over = powers[BLOCK]
        self._size = m, p
        self._state = np.zeros(n) if x0 is None else np.asarray(x0, float)

    def respond(self, u: Array) -> Array:
        """Return the response (N, m) to u (N, p).

        Another piece may follow if N is a multiple of BLOCK: the last one is filled up with zeros.
        """
        m, p = self._size
        rows = -(-len(u) // BLOCK) * BLOCK
        padded = np.zeros((rows, p))
        padded[: len(u)] = u
        blocks = padded.reshape(-1, BLOCK * p)
        driven = blocks @ self._reach.T
        x = np.empty((len(blocks), len(self._state)))
        for k in range(len(blocks)):
            x[k] = self._state
            self._state = self._over @ self._state + driven[k]
        y = blocks @ self._within.T + x @ self._observe.T
        return np.asarray(y.reshape(-1, m)[: len(u)])


def free_response(model: StateSpace, rows: int) -> Array:
    """Return the output (rows, m, n) caused by each unit initial state."""
    n = len(model.A)
    powers = np.empty((BLOCK + 1, n, n))
    powers[0] = np.eye(n)
    for k in range(BLOCK):
        powers[k + 1] = model.A @ powers[k]
    within = (model.C @ powers[:BLOCK]).reshape(-1, n)
    blocks = -(-rows // BLOCK)
    out = np.empty((blocks, *within.shape))
    for k in range(blocks):
        out[k] = within
        within = within @ powers[BLOCK]
    return out.reshape(blocks * BLOCK, len(model.C), n)[:rows]


def initial_state(model: StateSpace, u: Array, y: Array) -> Array:
    """Estimate the initial state (n,) by least squares of the simulation error of y (N, m).

    Outputs are divided by their rms.
    """
    n = len(model.A)
    weight = 1.0 / np.maximum(y.std(axis=0), np.finfo(float).tiny)
    residual = (y - simulate(model, u)) * weight

    def rows() -> Iterator[Array]:
        for k, free in _free_responses(model, len(u)):
            response = (free * weight[:, None]).reshape(-1, n)
            yield np.hstack([response, residual[k].reshape(-1, 1)])

    R = triangle(rows())
    return np.asarray(np.linalg.lstsq(R[:, :n], R[:, n], rcond=None)[0])


def spectral_radius(A: Array) -> float:
    """Return the largest modulus of the eigenvalues."""
    return float(np.abs(np.linalg.eigvals(A)).max())


def fit_input_matrices(model: StateSpace, records: Sequence[Record]) -> StateSpace:
    """Fit B and D to the records by least squares of the simulation error; A and C are kept.

    Outputs are divided by their rms; the initial state of every record is fitted too. A must be
    stable.
    """
    n, p = model.B.shape
    m = len(model.C)
    weight = 1.0 / np.maximum(_rms(records), np.finfo(float).tiny)

    def rows(record: Record) -> Iterator[Array]:
        driven = _input_regressors(model, record.v)
        for (k, free), by_input in zip(_free_responses(model, len(record.v)), driven, strict=True):
            columns = [(x * weight[:, None]).reshape(-1, x.shape[2]) for x in (free, by_input)]
            yield np.hstack([*columns, (record.y[k] * weight).reshape(-1, 1)])

    # The rows of the triangle below the initial state's are free of it.
    reduced = [triangle(rows(record))[n:, n:] for record in records]
    stacked = np.vstack(reduced)
    scale = np.maximum(np.linalg.norm(stacked[:, :-1], axis=0), np.finfo(float).tiny)
    found = np.linalg.lstsq(stacked[:, :-1] / scale, stacked[:, -1], rcond=None)[0] / scale
    B = found[: n * p].reshape(p, n).T
    D = found[n * p :].reshape(p, m).T
    return StateSpace(model.A, B, model.C, D, model.Ts_s)


def _blocks(rows: int) -> Iterator[slice]:
    return (slice(k, min(k + BLOCK_ROWS, rows)) for k in range(0, rows, BLOCK_ROWS))


def _free_responses(model: StateSpace, rows: int) -> Iterator[tuple[slice, Array]]:
    """Yield the rows of `free_response` block by block, to save memory."""
    response = free_response(model, min(rows, BLOCK_ROWS))
    block_power = np.linalg.matrix_power(model.A, BLOCK_ROWS)
    state = np.eye(len(model.A))
    for k in _blocks(rows):
        yield k, response[: k.stop - k.start] @ state
        state = block_power @ state


def _input_regressors(model: StateSpace, u: Array) -> Iterator[Array]:
    """Yield the output (N, m, n p + m p) caused by each unit entry of B and D, block by block.

    The state of entry B[i, j] obeys x(k + 1) = A x(k) + e_i u_j(k); it passes from block to block.
    """
    from scipy import signal  # its import takes a second, which a daemon would wait for

    m, n = model.C.shape
    states = free_response(replace(model, C=np.eye(n), D=np.zeros((n, 0))), BLOCK_ROWS)
    block_power = states[-1] @ model.A
    outputs = model.C @ states
    state = np.zeros((u.shape[1], n, n))
    for k in _blocks(len(u)):
        rows = k.stop - k.start
        columns = []
        for j, u_j in enumerate(u[k].T):
            driven = outputs[:rows] @ state[j]
            flat = outputs[:rows].reshape(rows, m * n)
            convolved = signal.fftconvolve(flat, u_j[:, None], axes=0)[: rows - 1]
            driven[1:] += convolved.reshape(-1, m, n)
            columns.append(driven)
            if rows == BLOCK_ROWS:
                state[j] = block_power @ state[j] + np.tensordot(u_j, states[::-1], 1)
        columns += [u_j[:, None, None] * np.eye(m) for u_j in u[k].T]
        yield np.concatenate(columns, axis=2)


def _rms(records: Sequence[Record]) -> Array:
    return np.asarray(np.sqrt(np.mean(np.concatenate([r.y for r in records]) ** 2, axis=0)))
