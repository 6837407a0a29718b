"""Ways to the plant P from the same records: levid's, and those of other packages.

Every contender takes the records of one beam position (each excites one input, the loop closed by
a known controller; together they are one unbroken flight) and returns P at given frequencies.
Those that identify the loop G from v to y go on by (14) with that controller, exactly and point by
point. A peer has the settings that served it best on three flights; what was tried stands beside
them. Where it gets fewer samples, v and y pass the same filter first, which leaves G as it is.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.io import loadmat, savemat

from levid.identification.data import PiController, Record
from levid.identification.frequency import (
    plant_from_loop_response,
    plant_from_sensitivity,
    sensitivity,
)
from levid.identification.ho_kalman import Scaling, decompose, realise
from levid.identification.loop import without_delay
from levid.identification.markov import estimate_markov, markov_response
from levid.identification.plant import Plant, plant_from_loop
from levid.model.second_order import StateSpace

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

LAG_S = 0.3e-3  # of the current loops, as config/models/rig.yaml declares it
ORDER = 12
"""States of the peers' G: nine, and three for the part of a sample in the delay (9 to 18 tried)."""


@dataclass(frozen=True)
class Contender:
    """One way from records to P: `identify` returns P (F, 3, 3) at freq_hz (F,)."""

    key: str
    label: str
    identify: Callable[[Sequence[Record], Array], Complex]
    package: str = ""  # to be imported; empty for levid's own

    @property
    def is_levid(self) -> bool:
        return self.key.startswith("levid")


def levid_ho_kalman(records: Sequence[Record], freq_hz: Array) -> Complex:
    """Least-squares Markov parameters, Ho-Kalman to nine states, and (14)."""
    Ts_s, delay, controller = records[0].Ts_s, records[0].leading_zeros, _controller(records)
    pole = float(np.exp(-Ts_s / LAG_S))
    markov = estimate_markov(records, impulse_taps(records), "least_squares")
    series = without_delay(markov.g, delay, pole, controller, Ts_s)
    loop = realise(decompose(series, Ts_s, Scaling.of(records)), 9)
    return Plant(plant_from_loop(loop, controller), delay, pole).response(freq_hz)


def levid_sensitivity(records: Sequence[Record], freq_hz: Array) -> Complex:
    """Sensitivity from v to u by correlating spectra of 10 s, and (15)."""
    S = sensitivity(records, freq_hz, 10.0)
    return plant_from_sensitivity(S, _controller(records)).H


def control_markov(records: Sequence[Record], freq_hz: Array) -> Complex:
    """python-control's Markov parameters of G."""
    fewer = [_every(r, 4) for r in records]
    g = _control_markov(fewer)
    loop = markov_response(g.transpose(2, 0, 1), freq_hz, fewer[0].Ts_s)
    return plant_from_loop_response(loop, _controller(records), freq_hz, records[0].Ts_s)


def control_realization(records: Sequence[Record], freq_hz: Array) -> Complex:
    """python-control's Markov parameters of G and their eigensystem realisation."""
    import control

    fewer = [_every(r, 4) for r in records]
    scaling = Scaling.of(fewer)
    g = _control_markov(fewer) / scaling.outputs[:, None, None] * scaling.inputs[:, None]
    # 250, 375, 500 and 750 blocks tried: more take up to a minute and gain nothing.
    blocks = min(250, (g.shape[2] - 2) // 2)
    G, _ = control.eigensys_realization(g, ORDER, m=blocks, n=blocks, dt=True)
    return _plant(G.A, G.B, G.C, G.D, scaling, fewer[0].Ts_s, records, freq_hz)


def sippy_n4sid(records: Sequence[Record], freq_hz: Array) -> Complex:
    """SIPPY's N4SID of G."""
    import sippy_unipi

    # Horizons of 20, 40, 60 and every 1st, 2nd, 4th, 8th sample tried. P from u to y, without (14),
    # is worse: 1.1 % instead of 0.6 % with every 4th sample.
    v, y, scaling, Ts_s = _joined(records, 2)
    G = sippy_unipi.system_identification(
        y.T, v.T, "N4SID", tsample=Ts_s, SS_f=40, SS_fixed_order=ORDER, SS_D_required=True
    )
    return _plant(G.A, G.B, G.C, G.D, scaling, Ts_s, records, freq_hz)


def nfoursid(records: Sequence[Record], freq_hz: Array) -> Complex:
    """nfoursid's subspace identification of G, column by column."""
    import pandas as pd
    from nfoursid.nfoursid import NFourSID

    # It makes a matrix as wide and as high as there are rows: 16 GB for all three records at every
    # 4th sample, so each record, with its one input, is identified by itself. Every 8th sample is
    # quick and far worse (30 %); every 3rd and less do not fit into 8 GB.
    G = np.empty((len(freq_hz), 3, 3), complex)
    for record in records:
        v, y, scaling, Ts_s = _joined([record], 4)
        names = [f"v{j}" for j in range(3)], [f"y{i}" for i in range(3)]
        j = int(np.flatnonzero(record.excited)[0])
        table = pd.DataFrame(np.hstack([v, y]), columns=[*names[0], *names[1]])
        method = NFourSID(table, names[1], [names[0][j]], num_block_rows=40)
        method.subspace_identification()
        found, _ = method.system_identification(ORDER)
        column = StateSpace(found.a, found.b, found.c, found.d, Ts_s).response(freq_hz)
        G[:, :, j] = column[:, :, 0] * scaling.outputs / scaling.inputs[j]
    return plant_from_loop_response(G, _controller(records), freq_hz, records[0].Ts_s)


def scipy_csd_direct(records: Sequence[Record], freq_hz: Array) -> Complex:
    """scipy's csd from plant input u to y, as if the loop were open."""
    U = np.zeros((len(freq_hz), 3, 3), complex)
    Y = np.zeros_like(U)
    for record in records:
        assert record.u is not None
        j = int(np.flatnonzero(record.excited)[0])
        # Two inputs move along in the loop, so one record alone does not tell them apart: all
        # three are needed, U U^H and Y U^H summed over them.
        U += _cross_spectra(record.u, record.u, record.Ts_s, freq_hz) / record.v[:, j].var()
        Y += _cross_spectra(record.y, record.u, record.Ts_s, freq_hz) / record.v[:, j].var()
    return np.asarray(Y @ np.linalg.inv(U))


def scipy_csd_loop(records: Sequence[Record], freq_hz: Array) -> Complex:
    """scipy's csd from v to y."""
    G = np.empty((len(freq_hz), 3, 3), complex)
    for record in records:
        j = int(np.flatnonzero(record.excited)[0])
        v = record.v[:, j : j + 1]
        across = _cross_spectra(record.y, v, record.Ts_s, freq_hz)
        G[:, :, j] = (across / _cross_spectra(v, v, record.Ts_s, freq_hz))[:, :, 0]
    return plant_from_loop_response(G, _controller(records), freq_hz, records[0].Ts_s)


def octave_n4sid(records: Sequence[Record], freq_hz: Array) -> Complex:
    """GNU Octave's n4sid (package control; SLICOT's IB01AD and IB01BD, compiled Fortran) of G."""
    v, y, scaling, Ts_s = _joined(records, 1)  # 40, 80, 120 block rows, every 1st and 2nd tried
    with tempfile.TemporaryDirectory() as folder:
        savemat(Path(folder) / "data.mat", {"v": v, "y": y, "Ts": Ts_s})
        script = (
            "pkg load control; load data.mat;"
            f"G = n4sid(iddata(y, v, Ts), 'n', {ORDER}, 's', 80, 'rcond', 1e-10);"
            "[A, B, C, D] = ssdata(G); save -v7 model.mat A B C D;"
        )
        command = ["octave-cli", "--norc", "--eval", script]
        try:
            subprocess.run(command, cwd=folder, check=True, capture_output=True)
        except FileNotFoundError:
            raise ModuleNotFoundError("no octave-cli", name="octave-cli") from None
        G = loadmat(Path(folder) / "model.mat")
    return _plant(G["A"], G["B"], G["C"], G["D"], scaling, Ts_s, records, freq_hz)


CONTENDERS = (
    Contender("levid_ho_kalman", "levid: least squares, Ho-Kalman", levid_ho_kalman),
    Contender("levid_sensitivity", "levid: sensitivity", levid_sensitivity),
    Contender("control_era", "python-control: markov, ERA", control_realization, "control"),
    Contender("control_markov", "python-control: markov", control_markov, "control"),
    Contender("sippy_n4sid", "sippy-unipi: N4SID", sippy_n4sid, "sippy_unipi"),
    Contender("nfoursid", "nfoursid", nfoursid, "nfoursid"),
    Contender("scipy_csd", "scipy: csd from v to y", scipy_csd_loop, "scipy"),
    Contender("scipy_csd_direct", "scipy: csd from u to y", scipy_csd_direct, "scipy"),
    Contender("octave_n4sid", "Octave, SLICOT: n4sid", octave_n4sid, "scipy"),
)
"""Whoever joins the comparison stands here; levid's own have keys that begin with `levid`."""


def impulse_taps(records: Sequence[Record]) -> int:
    """Return the Markov parameters of 8 s, or of a third of a record where that is less.

    The slowest mode, of the integrators, decays in 1.15 s: after 8 s a thousandth of it is left.
    """
    return min(round(8.0 / records[0].Ts_s), len(records[0].y) // 3)


def _controller(records: Sequence[Record]) -> PiController:
    controller = records[0].controller
    assert controller is not None
    return controller


def _every(record: Record, step: int) -> Record:
    """Return v and y of every `step`-th sample behind one and the same linear-phase filter."""
    if step == 1:
        return record

    def fewer(x: Array) -> Array:
        return signal.decimate(x - x.mean(axis=0), step, ftype="fir", axis=0, zero_phase=True)

    return replace(record, v=fewer(record.v), y=fewer(record.y), u=None, Ts_s=step * record.Ts_s)


def _joined(records: Sequence[Record], step: int) -> tuple[Array, Array, Scaling, float]:
    """Return v, y (N, 3) of all records in one, of about rms 1, with the units they have then."""
    whole = replace(
        records[0],
        v=np.vstack([r.v for r in records]),
        y=np.vstack([r.y - r.y.mean(axis=0) for r in records]),
    )
    fewer = _every(whole, step)
    scaling = Scaling.of([fewer])
    return fewer.v / scaling.inputs, fewer.y / scaling.outputs, scaling, fewer.Ts_s


def _control_markov(records: Sequence[Record]) -> Array:
    """Return g (3, 3, L) by control.markov: 6 s, each column from the record of its input.

    All inputs at once, or every sample, would be a matrix of 2 and more GB and take minutes;
    3 s of taps leave twice the error.
    """
    import control

    taps = min(round(6.0 / records[0].Ts_s), len(records[0].y) // 3)
    g = np.empty((3, 3, taps))
    for record in records:
        j = int(np.flatnonzero(record.excited)[0])
        g[:, j] = control.markov(record.y.T, record.v[:, j][None], taps, truncate=True)[:, 0]
    return g


def _cross_spectra(y: Array, x: Array, Ts_s: float, freq_hz: Array) -> Complex:
    """Return the cross spectra (F, m, p) of y (N, m) with x (N, p), segments of 10 s.

    csd(x, y) is E conj(X) Y: what the response from x to y has as its numerator.
    """
    rows = round(10.0 / Ts_s)
    _, spectra = signal.csd(x.T[None], y.T[:, None], 1.0 / Ts_s, nperseg=rows)
    return spectra[:, :, np.rint(freq_hz * 10.0).astype(int)].transpose(2, 0, 1)


def _plant(
    A: Array,
    B: Array,
    C: Array,
    D: Array,
    scaling: Scaling,
    Ts_s: float,
    records: Sequence[Record],
    freq_hz: Array,
) -> Complex:
    """Return P by (14) from a model of G in scaled signals with sampling time Ts_s."""
    G = StateSpace(A, B, C, D, Ts_s).response(freq_hz)
    G = G * scaling.outputs[:, None] / scaling.inputs
    return plant_from_loop_response(G, _controller(records), freq_hz, records[0].Ts_s)
