"""Export models and responses to python-control, scipy.signal, MATLAB and Octave."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.io import savemat

from ..config.files.atomic_write import atomic_file
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
"""Longest field name in MATLAB."""


def control_state_space(
    model: StateSpace | IdentifiedPlant, signals: SignalNames | None = None
) -> control.StateSpace:
    """Convert the model to python-control, with its sampling time and the names of `signals`.

    Delay and lag of an IdentifiedPlant become states. Raises ModuleNotFoundError without
    python-control.
    """
    module = _python_control()
    full = _state_space(model)
    return module.StateSpace(full.A, full.B, full.C, full.D, full.Ts_s, **_named(signals))


def control_frd(estimate: ResponseEstimate, signals: SignalNames | None = None) -> control.FRD:
    """Convert the response to python-control: (m, p, F) at rad/s, with the names of `signals`.

    Coherence and covariance are lost. Raises ModuleNotFoundError without python-control.
    """
    module = _python_control()
    omega_rad_s = 2 * np.pi * estimate.freq_hz
    response = estimate.H.transpose(1, 2, 0)
    return module.FRD(response, omega_rad_s, estimate.Ts_s, **_named(signals))


def scipy_state_space(model: StateSpace | IdentifiedPlant) -> signal.StateSpace:
    """Convert the model to scipy.signal: a `dlti`, or an `lti` if it is continuous.

    Delay and lag of an IdentifiedPlant become states.
    """
    full = _state_space(model)
    if full.Ts_s > 0:
        return signal.StateSpace(full.A, full.B, full.C, full.D, dt=full.Ts_s)
    return signal.StateSpace(full.A, full.B, full.C, full.D)


def write_mat(path: Path, result: IdentificationResult) -> None:
    """Write the identified models and measured responses of all K operating points for MATLAB.

    - A (n, n, K), B (n, p, K), C (m, n, K), D (m, p, K), Ts in s: the plant with delay and lag as
      states, for `ss(A, B, C, D, Ts)`. It is the recommended model; without one, Ho-Kalman's, and
      `trusted` (1, K) is 0. `method`: a cell with the method of each.
    - frf (m, p, F, K), its standard deviation frf_sd (of the complex entries) and freq (F, 1) in
      Hz: the measured response, for `idfrd(frf, freq, Ts, 'FrequencyUnit', 'Hz')` at each point.
    - beam_m (1, K) in m, nan without a beam; input_names, input_units, output_names, output_units:
      cells of text.

    For K = 1 the last dimension is left out. A to D are cells {1, K} if the orders differ; frf,
    frf_sd and freq if the frequencies differ. The file has MATLAB's format 5, which Octave and
    scipy.io read too.
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
    _save(path, contents)


def write_multisine_mat(path: Path, blas: Sequence[BestLinearApproximation]) -> None:
    """Write the best linear approximations at K positions in the format of write_mat.

    frf, freq, Ts, beam_m and names as there; frf_sd covers all errors, frf_noise_sd noise alone,
    frf_distortion_sd the distortion of one realisation (nan if unknown).
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
    _save(path, contents)


def write_fitted_mat(path: Path, grey: GreyBox) -> None:
    """Write the fitted model, at the declared scheduling variables, in the format of write_mat.

    - A, B, C, D, Ts and names as there.
    - parameters: a struct of the fitted values in SI units; standard_errors: a struct of their
      standard errors, nan if unknown. Invalid field names are changed (see `_fields`).
    - input_hold: the input between samples, zoh, foh or band_limited. For band_limited the model is
      continuous, with Ts 0 and the input delay input_delay_s in s (0 otherwise: it is in A to D).
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
    _save(path, contents)


def _save(path: Path, contents: Mapping[str, Any]) -> None:
    with atomic_file(path) as file:
        savemat(cast("Any", file), contents, appendmat=False, long_field_names=True)


def fitted_signals(grey: GreyBox) -> SignalNames:
    """Return names and units of a fitted model's inputs and outputs, and the sampling time."""
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
    """Return frf, frf_sd, freq and beam_m from (freq_hz, H (F, m, p), deviation) of each point."""
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
    """Return a valid, unique MATLAB field for each name: at most 63 characters, no leading _."""
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
            "expected the package python-control, found none; run: pip install levid[control]",
            name="control",
        ) from None


def _named(signals: SignalNames | None) -> dict[str, list[str]]:
    if signals is None:
        return {}
    return {"inputs": list(signals.input_names), "outputs": list(signals.output_names)}


def _together(arrays: Sequence[NDArray[Any]], alike: bool) -> NDArray[Any]:
    """Stack the arrays along a new last dimension (one alone as it is); a cell if not alike."""
    if not alike:
        return _cell(arrays)
    return arrays[0] if len(arrays) == 1 else np.stack(arrays, axis=-1)


def _cell(items: Sequence[object]) -> NDArray[np.object_]:
    """Return the items as a MATLAB cell (1, K)."""
    cell = np.empty((1, len(items)), dtype=object)
    for k, item in enumerate(items):
        cell[0, k] = item
    return cell
