"""From the loop's responses to the plant: the joint input-output approach, with its covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..records.record import IdentificationError, Record
from .frequency_response import ResponseEstimate

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def joint_signals(record: Record) -> Array:
    """Return [y, u - v] (N, m + p): what a response from v must be taken to for the plant.

    Where the input is not fed back (u is not known) it is y alone, (N, m).
    """
    return record.y if record.u is None else np.hstack([record.y, record.u - record.v])


def plant_from_joint_response(loop: ResponseEstimate, outputs: int) -> ResponseEstimate:
    """Return P = (Y / V) (U / V)^-1 from the response of v to [y, u - v] of so many outputs y.

    With u - v rather than u nothing is rounded where feedback is weak. From dP = ([I, -P] dG)
    (U / V)^-1 follows the covariance. Without u - v it is the response as it comes.

    Raises IdentificationError when v leaves the plant without input somewhere.
    """
    p = loop.H.shape[2]
    if loop.H.shape[1] == outputs:
        return loop
    S = np.eye(p) + loop.H[:, outputs:]
    if np.linalg.cond(S).max() > 1e12:
        raise IdentificationError(
            "expected an excitation that reaches the plant at every frequency"
        )
    inverse = np.asarray(np.linalg.inv(S), dtype=np.complex128)
    P = loop.H[:, :outputs] @ inverse
    eye = np.broadcast_to(np.eye(outputs), (len(P), outputs, outputs))
    left = np.concatenate([eye, -P], axis=2)
    half = np.einsum("fai,fijkl,fjb->fabkl", left, loop.covariance, inverse, optimize=True)
    covariance = np.einsum("fabkl,fck,fld->fabcd", half, left.conj(), inverse.conj(), optimize=True)
    return ResponseEstimate(
        loop.freq_hz, P, loop.coherence[:, :outputs], np.asarray(covariance), loop.Ts_s
    )
