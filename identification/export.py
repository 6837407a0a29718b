"""Models and responses for other tools: python-control, scipy.signal, MATLAB and Octave."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.io import savemat

from ..model.second_order import StateSpace
from .greybox.identify_greybox import GreyBox
from .nonparametric.frequency_response import ResponseEstimate
from .nonparametric.robust_multisine import BestLinearApproximation
from .records.signal_names import SignalNames
from .results import ClosedLoopPoint, IdentificationResult, OpenLoopPoint
from .subspace.plant_from_loop import IdentifiedPlant

if TYPE_CHECKING:
    import control

Array = NDArray[np.float64]

_FIELD_CHARACTERS = 63
"""Of a field's name MATLAB keeps so many."""


def control_state_space(
    model: StateSpace | IdentifiedPlant, signals: SignalNames | None = None
) -> control.StateSpace:
    """Return the model for python-control, with its sampling time, named after `signals` if given.

    The delay and the lag of a Plant become states. Raises ModuleNotFoundError without
    python-control.
    """
    module = _python_control()
    full = _state_space(model)
    return module.StateSpace(full.A, full.B, full.C, full.D, full.Ts_s, **_named(signals))


def control_frd(estimate: ResponseEstimate, signals: SignalNames | None = None) -> control.FRD:
    """Return the response for python-control: (m, p, F) at rad/s, named after `signals` if given.

    What it cannot hold, coherence and covariance, stays behind. Raises ModuleNotFoundError without
    python-control.
    """
    module = _python_control()
    omega_rad_s = 2 * np.pi * estimate.freq_hz
    response = estimate.H.transpose(1, 2, 0)
    return module.FRD(response, omega_rad_s, estimate.Ts_s, **_named(signals))


def scipy_state_space(model: StateSpace | IdentifiedPlant) -> signal.StateSpace:
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
    models): A (n, n, K), B (n, p, K), C (m, n, K), D (m, p, K), Ts in s. It is the one that the
    identification recommends; where it can recommend none, Ho-Kalman's, and `trusted` (1, K) is 0.
    `method`: a cell of how each was found. The response measured
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
    measured = _measured(
        [(e.freq_hz, e.H, e.standard_deviation) for e in spectra],
        [p.beam_m for p in result.points],
    )
    contents = {**_matrices(models), **measured, **_signals(result.signals)}
    contents["method"] = _cell([_method(point) for point in result.points])
    contents["trusted"] = np.array([[float(_trusted(point)) for point in result.points]])
    savemat(path, contents, appendmat=False)


def write_multisine_mat(path: Path, blas: Sequence[BestLinearApproximation]) -> None:
    """Write the best linear approximations at K positions as write_mat writes responses.

    frf, freq, Ts, beam_m and the names as there; frf_sd from all errors, frf_noise_sd from noise
    alone, frf_distortion_sd what distortion adds to one realisation, nan where it is not known.
    """
    contents = {
        **_measured(
            [(b.freq_hz, b.H, b.standard_deviation) for b in blas], [b.beam_m for b in blas]
        ),
        **_signals(blas[0].signals),
    }
    same_grid = _alike([b.freq_hz for b in blas])
    for name, values in (
        ("frf_noise_sd", [b.noise_deviation for b in blas]),
        ("frf_distortion_sd", [np.sqrt(b.distortion_variance) for b in blas]),
    ):
        contents[name] = _together([v.transpose(1, 2, 0) for v in values], same_grid)
    savemat(path, contents, appendmat=False)


def write_fitted_mat(path: Path, grey: GreyBox) -> None:
    """Write the fitted model where its scheduling variables are as declared, as write_mat.

    A, B, C, D, Ts and the names; parameters: a struct of the fitted values in SI units, and
    standard_errors: one of theirs, nan where there is none; names that MATLAB does not take for a
    field as _fields has them. input_hold: what the input does between samples, zoh, foh or
    band_limited. Of a band-limited one the model is continuous, Ts 0, and input_delay_s in s is the
    delay before it (0 else: it is in A to D).
    """
    model, delay_s = grey.state_space({})
    parameters = grey.fitted.parameters
    fields = _fields(parameters)
    contents = {
        **_matrices([model]),
        **_signals(fitted_signals(grey)),
        "Ts": model.Ts_s,
        "input_hold": grey.declared.input,
        "input_delay_s": delay_s,
        "parameters": {fields[name]: p.value for name, p in parameters.items()},
        "standard_errors": {
            fields[name]: np.nan if p.se is None else p.se for name, p in parameters.items()
        },
    }
    savemat(path, contents, appendmat=False, long_field_names=True)


def fitted_signals(grey: GreyBox) -> SignalNames:
    """Return names and units of a fitted model's inputs and outputs."""
    inputs, dof = grey.declared.inputs, grey.declared.dof
    return SignalNames(
        tuple(q.name for q in inputs),
        tuple(q.unit for q in inputs),
        tuple(q.name for q in dof),
        tuple(q.unit for q in dof),
        grey.Ts_s,
    )


def _matrices(models: Sequence[StateSpace]) -> dict[str, Any]:
    same_order = len({len(m.A) for m in models}) == 1
    return {
        name: _together([getattr(m, name) for m in models], same_order)
        for name in ("A", "B", "C", "D")
    }


def _measured(
    responses: Sequence[tuple[Array, NDArray[np.complex128], Array]],
    beams_m: Sequence[float | None],
) -> dict[str, Any]:
    """Return frequencies, responses (F, m, p) and standard deviations of each point, and beam_m."""
    same_grid = _alike([freq_hz for freq_hz, _, _ in responses])
    freq_hz = [f[:, None] for f, _, _ in responses]
    return {
        "frf": _together([H.transpose(1, 2, 0) for _, H, _ in responses], same_grid),
        "frf_sd": _together([sd.transpose(1, 2, 0) for _, _, sd in responses], same_grid),
        "freq": freq_hz[0] if same_grid else _cell(freq_hz),
        "beam_m": np.array([[np.nan if beam is None else beam for beam in beams_m]]),
    }


def _signals(signals: SignalNames) -> dict[str, Any]:
    return {
        "Ts": signals.Ts_s,
        "input_names": _cell(signals.input_names),
        "input_units": _cell(signals.input_units),
        "output_names": _cell(signals.output_names),
        "output_units": _cell(signals.output_units),
    }


def _fields(names: Iterable[str]) -> dict[str, str]:
    """Return the field of a MATLAB struct by name: p_ before a _, 63 characters, each once."""
    fields: dict[str, str] = {}
    for name in names:
        whole = f"p_{name}" if name.startswith("_") else name
        field, k = whole[:_FIELD_CHARACTERS], 2
        while field in fields.values():
            field, k = f"{whole[: _FIELD_CHARACTERS - 4]}_{k}", k + 1
        fields[name] = field
    return fields


def _alike(grids: Sequence[Array]) -> bool:
    return all(np.array_equal(grid, grids[0]) for grid in grids)


def _state_space(model: StateSpace | IdentifiedPlant) -> StateSpace:
    return model.state_space() if isinstance(model, IdentifiedPlant) else model


def _model(point: ClosedLoopPoint | OpenLoopPoint) -> StateSpace:
    if isinstance(point, OpenLoopPoint):
        return point.model
    return (point.recommended or point.plant).state_space()


def _method(point: ClosedLoopPoint | OpenLoopPoint) -> str:
    if isinstance(point, OpenLoopPoint) or point.recommended is None:
        return "ho_kalman"
    return "ho_kalman" if point.recommended is point.plant else "subspace"


def _trusted(point: ClosedLoopPoint | OpenLoopPoint) -> bool:
    return isinstance(point, OpenLoopPoint) or point.recommended is not None


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


def _named(signals: SignalNames | None) -> dict[str, list[str]]:
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
