"""Models and responses for other tools: python-control, scipy.signal, MATLAB and Octave."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.io import savemat

from ..model.second_order import StateSpace
from .frequency import ResponseEstimate
from .plant import Plant
from .results import ClosedLoopPoint, IdentificationResult, OpenLoopPoint, Signals

if TYPE_CHECKING:
    import control

Array = NDArray[np.float64]


def control_state_space(
    model: StateSpace | Plant, signals: Signals | None = None
) -> control.StateSpace:
    """Return the model for python-control, with its sampling time, named after `signals` if given.

    The delay and the lag of a Plant become states. Raises ModuleNotFoundError without
    python-control.
    """
    module = _python_control()
    full = _state_space(model)
    return module.StateSpace(full.A, full.B, full.C, full.D, full.Ts_s, **_named(signals))


def control_frd(estimate: ResponseEstimate, signals: Signals | None = None) -> control.FRD:
    """Return the response for python-control: (m, p, F) at rad/s, named after `signals` if given.

    What it cannot hold, coherence and covariance, stays behind. Raises ModuleNotFoundError without
    python-control.
    """
    module = _python_control()
    omega_rad_s = 2 * np.pi * estimate.freq_hz
    response = estimate.H.transpose(1, 2, 0)
    return module.FRD(response, omega_rad_s, estimate.Ts_s, **_named(signals))


def scipy_state_space(model: StateSpace | Plant) -> signal.StateSpace:
    """Return the model for scipy.signal: a `dlti`, or an `lti` where it is continuous.

    The delay and the lag of a Plant become states.
    """
    full = _state_space(model)
    if full.Ts_s > 0:
        return signal.StateSpace(full.A, full.B, full.C, full.D, dt=full.Ts_s)
    return signal.StateSpace(full.A, full.B, full.C, full.D)


def write_mat(path: Path, result: IdentificationResult) -> None:
    """Write the identified models and measured responses of all K operating points for MATLAB.

    The plant with delay and lag as states, as `ss(A, B, C, D, Ts)` takes it (as an array of K
    models): A (n, n, K), B (n, p, K), C (m, n, K), D (m, p, K), Ts in s. The response measured
    without a model, a point of which `idfrd(frf, freq, Ts, 'FrequencyUnit', 'Hz')` takes: frf
    (m, p, F, K) with its standard deviation frf_sd (of the complex entries), freq (F, 1) in Hz.
    beam_m (1, K) in m, nan without a beam. input_names, input_units, output_names, output_units:
    cells of text.

    For K = 1 the last dimension is left out. A to D are cells {1, K} where the points differ in
    order; frf, frf_sd and freq where they differ in freq. The file is MATLAB's format 5, which
    Octave and scipy.io read too.
    """
    models = [_model(point) for point in result.points]
    spectra = [_spectra(point) for point in result.points]
    same_order = len({len(m.A) for m in models}) == 1
    same_grid = all(np.array_equal(e.freq_hz, spectra[0].freq_hz) for e in spectra)
    freq_hz = [e.freq_hz[:, None] for e in spectra]
    signals = result.signals
    contents = {
        "A": _together([m.A for m in models], same_order),
        "B": _together([m.B for m in models], same_order),
        "C": _together([m.C for m in models], same_order),
        "D": _together([m.D for m in models], same_order),
        "Ts": signals.Ts_s,
        "frf": _together([e.H.transpose(1, 2, 0) for e in spectra], same_grid),
        "frf_sd": _together([e.standard_deviation.transpose(1, 2, 0) for e in spectra], same_grid),
        "freq": freq_hz[0] if same_grid else _cell(freq_hz),
        "beam_m": np.array([[np.nan if p.beam_m is None else p.beam_m for p in result.points]]),
        "input_names": _cell(signals.input_names),
        "input_units": _cell(signals.input_units),
        "output_names": _cell(signals.output_names),
        "output_units": _cell(signals.output_units),
    }
    savemat(path, contents, appendmat=False)


def _state_space(model: StateSpace | Plant) -> StateSpace:
    return model.state_space() if isinstance(model, Plant) else model


def _model(point: ClosedLoopPoint | OpenLoopPoint) -> StateSpace:
    return point.plant.state_space() if isinstance(point, ClosedLoopPoint) else point.model


def _spectra(point: ClosedLoopPoint | OpenLoopPoint) -> ResponseEstimate:
    return point.from_sensitivity if isinstance(point, ClosedLoopPoint) else point.from_spectra


def _python_control() -> ModuleType:
    try:
        return importlib.import_module("control")
    except ModuleNotFoundError as error:
        if error.name != "control":
            raise
        raise ModuleNotFoundError(
            "expected the package control (python-control), found none: pip install levid[control]",
            name="control",
        ) from None


def _named(signals: Signals | None) -> dict[str, list[str]]:
    if signals is None:
        return {}
    return {"inputs": list(signals.input_names), "outputs": list(signals.output_names)}


def _together(arrays: Sequence[NDArray[Any]], alike: bool) -> NDArray[Any]:
    """Return the arrays along a new last dimension, one alone as it is; a cell of unlike ones."""
    if not alike:
        return _cell(arrays)
    return arrays[0] if len(arrays) == 1 else np.stack(arrays, axis=-1)


def _cell(items: Sequence[object]) -> NDArray[np.object_]:
    """Return items as a row, which savemat writes as a cell."""
    cell = np.empty((1, len(items)), dtype=object)
    for k, item in enumerate(items):
        cell[0, k] = item
    return cell
