"""Methods to identify the plant P from one flight: levid's, and those of other packages.

Each contender gets a flight at one beam position (each record excites one input, the loop closed by
a known controller) and returns P at given frequencies.

A peer has the settings and data preparation that served it best on three flights; comments list
what was tried. Methods that identify the loop G from v to y continue by (14) with the controller,
exactly and point by point; if they get fewer samples, v and y pass the same filter first, which
leaves G unchanged. Methods that tolerate feedback identify the core Q from u to y, behind the known
delay and lag, as levid does.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import signal
from scipy.io import loadmat, savemat

from levid.benchmarks.identification.simulated_flight_and_truth import LAG_S, Array, Complex
from levid.identification.nonparametric.frequency_response import plant_from_loop_response
from levid.identification.nonparametric.markov_parameters import (
    estimate_markov,
    most_taps,
)
from levid.identification.records.record import PiController, Record
from levid.identification.subspace.delay_removal import without_delay
from levid.identification.subspace.ho_kalman import Scaling, decompose, realise
from levid.identification.subspace.plant_by_spectra import plant_by_spectra
from levid.identification.subspace.plant_from_loop import IdentifiedPlant, plant_from_loop
from levid.model.second_order import StateSpace

ORDER = 12
"""States of the peers' G: nine, and three for the part of a sample in the delay (9 to 18 tried)."""


@dataclass(frozen=True)
class Contender:
    """One method: `identify` returns P (F, 3, 3) at freq_hz (F,) from the records of a flight."""

    key: str
    label: str
    identify: Callable[[Sequence[Record], Array], Complex]
    package: str = ""  # to be imported; empty for levid's own


def levid_ho_kalman(records: Sequence[Record], freq_hz: Array) -> Complex:
    """Least-squares Markov parameters, Ho-Kalman to nine states, and (14)."""
    Ts_s, delay, controller = records[0].Ts_s, records[0].leading_zeros, _controller(records)
    pole = _lag_pole(records)
    markov = estimate_markov(records, impulse_taps(records), "least_squares")
    series = without_delay(markov.g, delay, pole, controller, Ts_s)
    loop = realise(decompose(series, Ts_s, Scaling.of(records)), 9)
    return IdentifiedPlant(plant_from_loop(loop, controller), delay, pole).response(freq_hz)


def levid_subspace(records: Sequence[Record], freq_hz: Array) -> Complex:
    """Subspace of the measured response, fitted to the spectra: the plant's six states."""
    return plant_by_spectra(records, 6, _lag_pole(records)).plant.response(freq_hz)


def control_realization(records: Sequence[Record], freq_hz: Array) -> Complex:
    """python-control's Markov parameters of G and their eigensystem realisation."""
    import control

    # 6 s of taps, each column from the record of its input. All inputs at once, or every sample,
    # would be a matrix of 2 and more GB and take minutes; 3 s of taps leave twice the error.
    fewer = [_every(r, 4) for r in records]
    scaling = Scaling.of(fewer)
    taps = min(round(6.0 / fewer[0].Ts_s), len(fewer[0].y) // 3)
    g = np.empty((3, 3, taps))
    for record in fewer:
        j = int(np.flatnonzero(record.excited)[0])
        g[:, j] = control.markov(record.y.T, record.v[:, j][None], taps, truncate=True)[:, 0]
    g = g / scaling.outputs[:, None, None] * scaling.inputs[:, None]
    # 250, 375, 500 and 750 blocks tried: more take up to a minute and gain nothing.
    blocks = min(250, (taps - 2) // 2)
    G, _ = control.eigensys_realization(g, ORDER, m=blocks, n=blocks, dt=True)
    loop = _unscaled(G.A, G.B, G.C, G.D, scaling, fewer[0].Ts_s).response(freq_hz)
    return plant_from_loop_response(loop, _controller(records), freq_hz, records[0].Ts_s)


def sippy_n4sid(records: Sequence[Record], freq_hz: Array) -> Complex:
    """SIPPY's N4SID of Q."""
    import sippy_unipi

    # Horizons of 20, 40, 60 and every 1st, 2nd, 4th, 8th sample tried. Without the preparation, G
    # with every 2nd sample and 12 states has 15 times the error, P with 8 states 200 times.
    w, y, scaling = _core_signals(records)
    Q = sippy_unipi.system_identification(
        y.T, w.T, "N4SID", tsample=records[0].Ts_s, SS_f=40, SS_fixed_order=6, SS_D_required=True
    )
    core = _unscaled(Q.A, Q.B, Q.C, Q.D, scaling, records[0].Ts_s)
    return _plant_from_core(core, records, freq_hz)


def nfoursid(records: Sequence[Record], freq_hz: Array) -> Complex:
    """nfoursid's subspace identification of G, column by column."""
    import pandas as pd
    from nfoursid.nfoursid import NFourSID

    # Its matrix is as wide and as high as there are rows: 16 GB for all three records at every 4th
    # sample, so each record, with its one input, is identified by itself. Every 8th sample is quick
    # and far worse (30 %); every 3rd and less do not fit into 8 GB.
    outputs, G = ["y0", "y1", "y2"], np.empty((len(freq_hz), 3, 3), complex)
    for record in records:
        j = int(np.flatnonzero(record.excited)[0])
        fewer = _every(record, 4)
        scaling = Scaling.of([fewer])
        table = pd.DataFrame(fewer.y / scaling.outputs, columns=outputs)
        table["v"] = fewer.v[:, j] / scaling.inputs[j]
        method = NFourSID(table, outputs, ["v"], num_block_rows=40)
        method.subspace_identification()
        found, _ = method.system_identification(ORDER)
        one = Scaling(scaling.outputs, scaling.inputs[j : j + 1])
        column = _unscaled(found.a, found.b, found.c, found.d, one, fewer.Ts_s)
        G[:, :, j] = column.response(freq_hz)[:, :, 0]
    return plant_from_loop_response(G, _controller(records), freq_hz, records[0].Ts_s)


def scipy_csd_direct(records: Sequence[Record], freq_hz: Array) -> Complex:
    """scipy's csd from plant input u to y, as if the loop were open."""
    U = np.zeros((len(freq_hz), 3, 3), complex)
    Y = np.zeros_like(U)
    for record in records:
        assert record.u is not None
        j = int(np.flatnonzero(record.excited)[0])
        # In the loop all inputs move in each record: all three records are needed, U U^H and Y U^H
        # summed over them.
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
    """GNU Octave's n4sid (package control; SLICOT's IB01AD and IB01BD, compiled Fortran) of Q."""
    # 20, 40, 80, 120 block rows tried. Without the preparation 9 states have twice, P of 12 states
    # three and G of 12 states four times the error.
    w, y, scaling = _core_signals(records)
    with tempfile.TemporaryDirectory() as folder:
        savemat(Path(folder) / "data.mat", {"w": w, "y": y, "Ts": records[0].Ts_s})
        script = (
            "pkg load control; load data.mat;"
            "Q = n4sid(iddata(y, w, Ts), 'n', 6, 's', 40, 'rcond', 1e-10);"
            "[A, B, C, D] = ssdata(Q); save -v7 model.mat A B C D;"
        )
        command = ["octave-cli", "--norc", "--eval", script]
        try:
            subprocess.run(command, cwd=folder, check=True, capture_output=True)
        except FileNotFoundError:
            raise ModuleNotFoundError("no octave-cli", name="octave-cli") from None
        Q = loadmat(Path(folder) / "model.mat")
    core = _unscaled(Q["A"], Q["B"], Q["C"], Q["D"], scaling, records[0].Ts_s)
    return _plant_from_core(core, records, freq_hz)


CONTENDERS = (
    Contender("levid_subspace", "levid: subspace", levid_subspace),
    Contender("levid_ho_kalman", "levid: Markov, Ho-Kalman", levid_ho_kalman),
    Contender("control_era", "python-control: markov, ERA", control_realization, "control"),
    Contender("sippy_n4sid", "sippy-unipi: N4SID", sippy_n4sid, "sippy_unipi"),
    Contender("nfoursid", "nfoursid", nfoursid, "nfoursid"),
    Contender("scipy_csd", "scipy: csd from v to y", scipy_csd_loop, "scipy"),
    Contender("scipy_csd_direct", "scipy: csd from u to y", scipy_csd_direct, "scipy"),
    Contender("octave_n4sid", "Octave, SLICOT: n4sid", octave_n4sid, "scipy"),
)


def _lag_pole(records: Sequence[Record]) -> float:
    return float(np.exp(-records[0].Ts_s / LAG_S))


def impulse_taps(records: Sequence[Record]) -> int:
    """Return the number of Markov parameters in 8 s, or the most that the records allow.

    The slowest mode, of the integrators, decays in 1.15 s: after 8 s a thousandth of it is left.
    """
    shortest = min(len(record.y) for record in records)
    return min(round(8.0 / records[0].Ts_s), shortest // 3, most_taps(records))


def _controller(records: Sequence[Record]) -> PiController:
    controller = records[0].controller
    assert controller is not None
    return controller


def _every(record: Record, step: int) -> Record:
    """Return v and y at every `step`-th sample, both behind one linear-phase filter."""

    def fewer(x: Array) -> Array:
        return signal.decimate(x - x.mean(axis=0), step, ftype="fir", axis=0, zero_phase=True)

    return replace(record, v=fewer(record.v), y=fewer(record.y), u=None, Ts_s=step * record.Ts_s)


def _core_signals(records: Sequence[Record]) -> tuple[Array, Array, Scaling]:
    """Return the whole flight in rms 1: Q's input, the output at that time, and their units."""
    pole, delay = _lag_pole(records), records[0].leading_zeros
    u = np.vstack([np.asarray(r.u) for r in records])
    lagged = signal.lfilter([1.0 - pole], [1.0, -pole], u - u[0], axis=0)
    whole = replace(
        records[0], v=lagged[:-delay], y=np.vstack([r.y for r in records])[delay:], u=None
    )
    scaling = Scaling.of([whole])
    w, y = whole.v / scaling.inputs, whole.y / scaling.outputs
    return w - w.mean(axis=0), y - y.mean(axis=0), scaling


def _plant_from_core(core: StateSpace, records: Sequence[Record], freq_hz: Array) -> Complex:
    """Return P from a model of Q."""
    return IdentifiedPlant(core, records[0].leading_zeros, _lag_pole(records)).response(freq_hz)


def _unscaled(A: Array, B: Array, C: Array, D: Array, scaling: Scaling, Ts_s: float) -> StateSpace:
    outputs = scaling.outputs[:, None]
    return StateSpace(A, B / scaling.inputs, C * outputs, D / scaling.inputs * outputs, Ts_s)


def _cross_spectra(y: Array, x: Array, Ts_s: float, freq_hz: Array) -> Complex:
    """Return the cross spectra (F, m, p) of y (N, m) with x (N, p), segments of 10 s.

    csd(x, y) is E conj(X) Y, the numerator of the response from x to y.
    """
    rows = round(10.0 / Ts_s)
    _, spectra = signal.csd(x.T[None], y.T[:, None], 1.0 / Ts_s, nperseg=rows)
    return spectra[:, :, np.rint(freq_hz * 10.0).astype(int)].transpose(2, 0, 1)
