"""Estimate the plant from closed-loop responses by the joint input-output approach."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..records.record import IdentificationError, Record
from .frequency_response import ResponseEstimate

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def joint_signals(record: Record) -> Array:
    """Return the signals [y, u - v] (N, m + p) whose responses to v determine the plant.

    In open loop, or if u is unknown, they are y alone, (N, m).
    """
    return record.y if record.u is None else np.hstack([record.y, record.u - record.v])


def plant_from_joint_response(loop: ResponseEstimate, outputs: int) -> ResponseEstimate:
    """Return P = (Y / V) (U / V)^-1 from the response of v to [y, u - v], y with m = `outputs`.

    u - v, unlike u, avoids rounding errors where feedback is weak. The covariance follows from
    dP = ([I, -P] dG) (U / V)^-1. Without u - v, P is the response itself.

    Raises IdentificationError if v does not reach the plant input at some frequency.
    """
    p = loop.H.shape[2]
    if loop.H.shape[1] == outputs:
        return loop
    S = np.eye(p) + loop.H[:, outputs:]
    if np.linalg.cond(S).max() > 1e12:
        raise IdentificationError(
            "expected excitation of the plant input at every frequency, found none at some"
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
