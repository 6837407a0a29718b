"""Check an identified plant: order, stability, held-out data, decay of the impulse response."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...model.second_order import StateSpace
from ..nonparametric.markov_parameters import MarkovEstimate, convolve
from ..records.record import Record
from .held_out_simulation import HoldOut
from .plant_from_loop import IdentifiedPlant
from .simulation import free_response, spectral_radius

Array = NDArray[np.float64]

PARTS = 6
"""Parts of an impulse response; the last of them is its end."""
VISIBLE_TRUNCATION = 1e-2
"""Relative rms of the truncated response above which the model errs visibly, by 0.1 dB."""
SETTLED = 3e-3
"""Largest share of the initial transient in a settled record."""
MIN_SIGNAL_POWER = 4.0
"""Mean square of the response's end over its error variance, above which it is signal."""
MAX_TRUNCATION = 1e-3
"""Largest relative rms of the truncated response: its resonances err by as much."""
STATES_A_DOF = 2
SETTLED_S = 4.0
"""Initial transients of the rig (decay rate 2.5 1/s) have decayed to 1e-4 after this time."""
LONGEST_SETTLING_S = 60.0
MIN_ERROR_SHARE = 0.05
"""Simulation error, as a share of an output's motion, below which it is ignored."""
MAX_ERROR_RATIO = 2.0
"""Largest rms error of a valid model over that of its Markov parameters, which are noisier."""


def has_decayed(markov: MarkovEstimate, tolerance: float = MAX_TRUNCATION) -> bool:
    """Return whether the end of the impulse response is noise, or below a relative tolerance.

    For every input and output, the rms of the last sixth of g is compared with its standard error
    and with the largest sixth; for couplings, with that of the two axes they couple.
    """
    rows = len(markov.g) // PARTS
    if rows < 1:
        return True
    sixths = markov.g[: PARTS * rows].reshape(PARTS, rows, *markov.g.shape[1:])
    power = np.mean(sixths**2, axis=1)
    last_rms = np.sqrt(power[-1])
    signal = last_rms > np.sqrt(MIN_SIGNAL_POWER) * markov.standard_error
    return not bool(
        np.any(signal & (last_rms > tolerance * _coupling_scale(np.sqrt(power.max(axis=0)))))
    )


def settling_time(loop: StateSpace, least_s: float, most_s: float) -> float:
    """Return the settling time of the loop in s: until SETTLED of its impulse response remains.

    The result is at least `least_s`; `most_s` for an unstable loop.
    """
    if spectral_radius(loop.A) >= 1.0:
        return most_s
    rows = round(most_s / loop.Ts_s)
    step = max(round(0.01 / loop.Ts_s), 1)
    # Steps of 10 ms suffice: resonances that ring for seconds are below 50 Hz.
    power = np.linalg.matrix_power(loop.A, step)
    thinned = StateSpace(power, loop.B, loop.C, loop.D, step * loop.Ts_s)
    g = free_response(thinned, max(rows // step, 1)) @ loop.B
    remaining = np.sqrt(np.cumsum(g[::-1] ** 2, axis=0)[::-1])
    ringing = np.flatnonzero(
        np.any(remaining > SETTLED * _coupling_scale(remaining[0]), axis=(1, 2))
    )
    end = ringing[-1] + 1 if len(ringing) else 0
    return float(np.clip(end * step * loop.Ts_s, least_s, most_s))


def predicted_errors(
    records: Sequence[Record], holdout: Sequence[HoldOut], markov: MarkovEstimate
) -> tuple[Array, ...]:
    """Return for each record the rms error (m,) of the Markov parameters on the held-out rows.

    The mean error is left out: the level is not modelled.
    """
    errors = []
    for record, held in zip(records, holdout, strict=True):
        rows = len(held.measured)
        error = held.measured - convolve(record.v, markov.g)[len(record.v) - rows :]
        errors.append(error.std(axis=0) if rows else np.zeros(held.measured.shape[1]))
    return tuple(errors)


def plant_doubts(
    plant: IdentifiedPlant, loop: StateSpace, holdout: Sequence[HoldOut], predicted: Sequence[Array]
) -> tuple[str, ...]:
    """Return the reasons, as text, not to use the identified plant; empty if there is none."""
    found = []
    states, p = plant.core.B.shape
    if states < STATES_A_DOF * p:
        found.append(
            f"{p} degrees of freedom need at least {STATES_A_DOF * p} states, "
            f"the plant has {states}"
        )
    if spectral_radius(loop.A) >= 1.0:
        found.append("the identified loop is unstable, but the measured loop was stable")
        return tuple(found)
    checked = [(h, e) for h, e in zip(holdout, predicted, strict=True) if len(h.measured)]
    # Scale by the motion when excited: small errors of an output that hardly moves are ignored.
    motion = np.max([held.measured.std(axis=0) for held, _ in checked], axis=0, initial=0.0)
    for held, expected in checked:
        error = (held.measured - held.simulated).std(axis=0)
        worse = (error > MAX_ERROR_RATIO * expected) & (error > MIN_ERROR_SHARE * motion)
        if np.any(worse) or not np.all(np.isfinite(error)):
            error_ratio = np.nan_to_num(error / np.maximum(expected, 1e-300), nan=np.inf)
            worst = int(np.argmax(np.where(worse | ~np.isfinite(error), error_ratio, 0.0)))
            found.append(
                f"held-out data of '{held.record}': the error of output {worst + 1} is "
                f"{error[worst] / expected[worst]:.1f} times that of the impulse response"
            )
    return tuple(found)


def _coupling_scale(size: Array) -> Array:
    """Return the geometric mean (p, p) of the two axes' own responses, by output and input."""
    own = np.sqrt(np.diag(size))
    return np.asarray(own[:, None] * own)
