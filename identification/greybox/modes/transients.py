"""Give the spectra that the begin and the end of a record leave at the outputs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from ....model.second_order import SecondOrder, state_space
from ...loop_spectra.spectral_lines import PointLines
from .mode import Mode

Complex = NDArray[np.complex128]


def transient_columns(at: SecondOrder, modes: Sequence[Mode], point: PointLines) -> Complex:
    """Return columns (F, n, T) of free motions of a structure with modes.

    The motion of a mode has a free direction; two rows of inputs are on their way (delay and lag).
    """
    n = len(at.M)
    z = np.exp(2j * np.pi * point.freq_hz * point.Ts_s)
    rigid = state_space(at)
    A = expm(rigid.A * point.Ts_s)
    shifted = z[:, None, None] * np.eye(len(A)) - A
    free = rigid.C @ np.linalg.solve(shifted, np.broadcast_to(np.eye(len(A)), shifted.shape))
    columns = [free * z[:, None, None]]
    eye = np.eye(n)
    for m in modes:
        if m.kind == "beyond":
            continue
        turn = m.omega * np.sqrt(max(1.0 - m.damping**2, 0.0))
        pole = np.exp(complex(-m.damping * m.omega, turn) * point.Ts_s)
        first, second = z / (z - pole), z / (z - np.conj(pole))
        for part in (first + second, 1j * (first - second)):
            columns.append(part[:, None, None] * eye)
    columns += [np.broadcast_to(eye, (len(z), n, n)), (1.0 / z)[:, None, None] * eye]
    return np.concatenate(columns, axis=2)
