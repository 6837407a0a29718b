"""Whether a model realised from a loop can be true: decay, stability, states, data kept back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...model.second_order import StateSpace
from ..nonparametric.markov_parameters import MarkovEstimate, convolve
from ..records.record import Record
from ..subspace.held_out_simulation import HoldOut
from .ho_kalman import OrderChoice
from .plant_from_loop import IdentifiedPlant
from .simulation import free_response, spectral_radius

Array = NDArray[np.float64]

PARTS = 6
"""The end of an impulse response is its last sixth."""
HARMS = 1e-2
"""Relative rms of what is cut off from which on a model suffers visibly, by 0.1 dB."""
SETTLED = 3e-3
"""Share of the response to what came before that a settled record may still show."""
NOISE = 4.0
"""Mean square of the end over its standard error's from which on it counts as signal."""
CUT_OFF = 1e-3
"""Relative rms that does no harm: what is cut off of a response makes its resonances err by it."""
STATES_A_DOF = 2
MATTERS = 0.05
"""Share of an output's motion that may be missed without a doubt."""
LEAST_GAP = 1.5
"""Least ratio of singular values that tells an order; the largest of noise alone is 1.02 to 1.1."""
WORSE = 2.0
"""Rms error of a true model over that of its Markov parameters, whose noise alone is larger."""


def has_decayed(markov: MarkovEstimate, cut_off: float = CUT_OFF) -> bool:
    """Say whether the end of the impulse response is noise, or less than `cut_off` of it.

    For every input and output: the rms of the last sixth of g against its standard error, and
    against the largest sixth on the way, of couplings that of both axes they couple.
    """
    rows = len(markov.g) // PARTS
    if rows < 1:
        return True
    sixths = markov.g[: PARTS * rows].reshape(PARTS, rows, *markov.g.shape[1:])
    power = np.mean(sixths**2, axis=1)
    end = np.sqrt(power[-1])
    signal = end > np.sqrt(NOISE) * markov.standard_error
    return not bool(np.any(signal & (end > cut_off * _of_axes(np.sqrt(power.max(axis=0))))))


def settling_time(loop: StateSpace, least_s: float, most_s: float) -> float:
    """Return how long the loop rings: until SETTLED of its impulse response is left, in s.

    At least `least_s`; of a loop that is not stable, `most_s`.
    """
    if spectral_radius(loop.A) >= 1.0:
        return most_s
    rows = round(most_s / loop.Ts_s)
    step = max(round(0.01 / loop.Ts_s), 1)
    # Every 10 ms will do: resonances are slower than 50 Hz where they ring for seconds.
    power = np.linalg.matrix_power(loop.A, step)
    thinned = StateSpace(power, loop.B, loop.C, loop.D, step * loop.Ts_s)
    g = free_response(thinned, max(rows // step, 1)) @ loop.B
    left = np.sqrt(np.cumsum(g[::-1] ** 2, axis=0)[::-1])
    ringing = np.flatnonzero(np.any(left > SETTLED * _of_axes(left[0]), axis=(1, 2)))
    last = ringing[-1] + 1 if len(ringing) else 0
    return float(np.clip(last * step * loop.Ts_s, least_s, most_s))


def predicted_errors(
    records: Sequence[Record], holdout: Sequence[HoldOut], markov: MarkovEstimate
) -> tuple[Array, ...]:
    """Return for each record the rms (m,) by which the Markov parameters miss the rows kept back.

    The level is not theirs to know; only scatter counts.
    """
    errors = []
    for record, held in zip(records, holdout, strict=True):
        rows = len(held.measured)
        error = held.measured - convolve(record.v, markov.g)[len(record.v) - rows :]
        errors.append(error.std(axis=0) if rows else np.zeros(held.measured.shape[1]))
    return tuple(errors)


def doubts(
    plant: IdentifiedPlant, loop: StateSpace, holdout: Sequence[HoldOut], predicted: Sequence[Array]
) -> tuple[str, ...]:
    """Return in words why the plant, in its loop, cannot be true; empty where nothing says so."""
    found = []
    states, p = plant.core.B.shape
    if states < STATES_A_DOF * p:
        found.append(
            f"the plant has {states} states, {p} degrees of freedom need {STATES_A_DOF * p} at "
            "least"
        )
    if spectral_radius(loop.A) >= 1.0:
        found.append("the identified loop is unstable, the one that flew was not")
        return tuple(found)
    judged = [(h, e) for h, e in zip(holdout, predicted, strict=True) if len(h.measured)]
    # What an output does where it is excited: small errors of what hardly moves are no matter.
    motion = np.max([held.measured.std(axis=0) for held, _ in judged], axis=0, initial=0.0)
    for held, expected in judged:
        error = (held.measured - held.simulated).std(axis=0)
        worse = (error > WORSE * expected) & (error > MATTERS * motion)
        if np.any(worse) or not np.all(np.isfinite(error)):
            times = np.nan_to_num(error / np.maximum(expected, 1e-300), nan=np.inf)
            worst = int(np.argmax(np.where(worse | ~np.isfinite(error), times, 0.0)))
            found.append(
                f"on rows kept back of '{held.record}' output {worst + 1} is missed by "
                f"{error[worst] / expected[worst]:.1f} times the error of the impulse response"
            )
    return tuple(found)


def order_doubts(choice: OrderChoice) -> tuple[str, ...]:
    """Return in words that no gap of the singular values tells the order; empty where one does."""
    if choice.gap >= LEAST_GAP:
        return ()
    return (
        f"the singular values leave no gap: s({choice.order}) / s({choice.order + 1}) is the "
        f"largest with {choice.gap:.2g}, so that {choice.order} states are a guess",
    )


def _of_axes(size: Array) -> Array:
    """Return by output and input the geometric mean of their two axes' own responses (p, p)."""
    own = np.sqrt(np.diag(size))
    return np.asarray(own[:, None] * own)
