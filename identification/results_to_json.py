"""Convert identification results to JSON data."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from ..model.second_order import StateSpace
from .greybox.fit_in_loop import FittedLoop
from .greybox.identify_greybox import GreyBox
from .greybox.modes.mode_shapes import ModeShape
from .json_data import plain_json
from .nonparametric.markov_parameters import MarkovEstimate
from .nonparametric.robust_multisine import BestLinearApproximation
from .results import ClosedLoopPoint, IdentificationResult, OpenLoopPoint, SubspacePoint
from .run_identification import Study
from .subspace.held_out_simulation import HoldOut
from .subspace.plant_from_loop import IdentifiedPlant
from .subspace.response_uncertainty import Modes

_RESPONSES = 30
"""Frequencies of a response in JSON: 11 a decade."""


def summary(result: IdentificationResult) -> dict[str, Any]:
    """Return the result as dicts, lists, finite numbers and text; None replaces nan.

    Models are complete. Responses are left out, except the subspace method's at some frequencies,
    because its standard errors do not follow from the matrices.
    """
    s = result.signals
    out = {
        "Ts_s": s.Ts_s,
        "inputs": _named(s.input_names, s.input_units),
        "outputs": _named(s.output_names, s.output_units),
        "points": [
            _closed(p) if isinstance(p, ClosedLoopPoint) else _open(p) for p in result.points
        ],
        "skipped": list(result.skipped),
    }
    cleaned = plain_json(out)
    assert isinstance(cleaned, dict)
    return cleaned


def _closed(point: ClosedLoopPoint) -> dict[str, Any]:
    return {
        "kind": "closed loop",
        "beam_m": point.beam_m,
        "records": point.records,
        "order": point.order,
        "singular_values": point.singular_values,
        "noise_levels": point.noise_levels,
        "markov": {name: _markov(m) for name, m in point.markov.items()},
        "loop": _model(point.loop),
        "plant": _plant(point.plant),
        "holdout": [_holdout(h) for h in point.holdout],
        "remarks": point.remarks,
        "trusted": point.trusted,
        "doubts": point.doubts,
        "subspace": None if point.subspace is None else _subspace(point.subspace),
        "recommended": _recommended(point),
    }


def _recommended(point: ClosedLoopPoint) -> str | None:
    if point.recommended is None:
        return None
    return "plant" if point.recommended is point.plant else "subspace"


def _subspace(found: SubspacePoint) -> dict[str, Any]:
    response, modes = found.response, found.modes
    some = np.linspace(0, len(response.freq_hz) - 1, _RESPONSES).round().astype(int)
    return {
        "order": found.order,
        "doubtful_orders": found.found.doubtful_orders,
        "singular_values": found.found.singular_values,
        "noise_level": found.found.noise_level,
        "top_hz": found.found.top_hz,
        "white": found.found.white,
        "plant": _plant(found.plant),
        "modes": _modes(modes),
        "response": {
            "freq_hz": response.freq_hz[some],
            "magnitude": np.abs(response.H[some]),
            "magnitude_se": response.magnitude_deviation[some],
            "phase_rad": np.angle(response.H[some]),
            "phase_se_rad": response.phase_deviation_rad[some],
        },
        "holdout": [_holdout(h) for h in found.holdout],
        "trusted": found.trusted,
        "doubts": found.doubts,
    }


def _modes(modes: Modes) -> list[dict[str, float]]:
    return [
        {"frequency_hz": f, "frequency_se_hz": f_se, "damping": d, "damping_se": d_se}
        for f, f_se, d, d_se in zip(
            modes.frequency_hz, modes.frequency_se_hz, modes.damping, modes.damping_se, strict=True
        )
    ]


def _plant(plant: IdentifiedPlant) -> dict[str, Any]:
    return {
        **_model(plant.core),
        "delay_steps": plant.delay_steps,
        "lag_pole": plant.lag_pole,
    }


def _open(point: OpenLoopPoint) -> dict[str, Any]:
    return {
        "kind": "open loop",
        "beam_m": point.beam_m,
        "records": point.records,
        "order": point.order,
        "predictor_order": point.predictor_order,
        "validation_error": point.validation_error,
        "predictor_validation_error": point.predictor_validation_error,
        "singular_values": point.singular_values,
        "markov": {name: _markov(m) for name, m in point.markov.items()},
        "impulse": {
            "taps": point.impulse.taps,
            "length_s": point.impulse.length_s,
            "chosen_by": point.impulse.chosen_by,
            "validation_error": point.impulse.validation_error,
        },
        "model": {**_model(point.model), "modes": _modes(point.modes)},
        "stable": point.stable,
        "predictor": {
            **_model(point.predictor.model),
            "K": point.predictor.K,
            "modes": _modes(point.predictor_modes),
        },
        "holdout": [_holdout(h) for h in point.holdout],
        "remarks": point.remarks,
        "trusted": point.trusted,
        "doubts": point.doubts,
        "origins": [{**asdict(o), "unexcited": o.unexcited} for o in point.origins],
    }


def _model(model: StateSpace) -> dict[str, Any]:
    poles = np.linalg.eigvals(model.A).astype(complex)
    with np.errstate(divide="ignore", invalid="ignore"):  # a pole at 0 has no frequency
        s = np.log(poles) / model.Ts_s
        damping = -s.real / np.maximum(np.abs(s), np.finfo(float).tiny)
    order = np.argsort(np.abs(s))
    return {
        "A": model.A,
        "B": model.B,
        "C": model.C,
        "D": model.D,
        "pole_frequency_hz": np.abs(s[order]) / (2 * np.pi),
        "pole_damping": damping[order],
    }


def _markov(estimate: MarkovEstimate) -> dict[str, Any]:
    return {
        "taps": len(estimate.g),
        "standard_error": estimate.standard_error,
        "residual_rms": estimate.residual_rms,
    }


def _holdout(holdout: HoldOut) -> dict[str, Any]:
    return {
        "record": holdout.record,
        "rows": len(holdout.time_s),
        "simulated_fit_percent": holdout.simulated_fit_percent,
        "predicted_fit_percent": holdout.predicted_fit_percent,
    }


def _named(names: tuple[str, ...], units: tuple[str, ...]) -> list[dict[str, str]]:
    return [{"name": n, "unit": u} for n, u in zip(names, units, strict=True)]


def study_summary(found: Study) -> dict[str, Any]:
    """Return all results of a study as JSON data: `summary`, multisine and grey box."""
    out: dict[str, Any] = summary(found.points) if found.points is not None else {}
    if found.multisine:
        out["multisine"] = [_multisine(bla) for bla in found.multisine]
    if found.grey is not None:
        out["grey_box"] = _grey_box(found.grey)
    out["notes"] = list(found.notes)
    cleaned = plain_json(out)
    assert isinstance(cleaned, dict)
    return cleaned


def _multisine(bla: BestLinearApproximation) -> dict[str, Any]:
    tests = {"distortion": bla.test(), "even": bla.even.test(), "odd": bla.odd.test()}
    return {
        "beam_m": bla.beam_m,
        "records": bla.records,
        "lines": len(bla.freq_hz),
        "tests": {name: {"ratio": t.ratio, "p_value": t.p_value} for name, t in tests.items()},
        "remarks": bla.remarks,
    }


def _grey_box(grey: GreyBox) -> dict[str, Any]:
    fitted = grey.fitted.parameters
    return {
        "input_hold": grey.declared.input,
        "parameters": {
            name: {
                "value": p.value,
                "se": p.se,
                "unit": p.unit,
                "declared": grey.declared.parameters[name].value,
            }
            for name, p in fitted.items()
        },
        "covariance": {"parameters": grey.fit.free, "matrix": grey.fit.covariance},
        "balance": grey.balance
        and {
            "band_hz": grey.balance.band_hz,
            "by_band": dict(zip(grey.balance.names, grey.balance.by_band.T, strict=True)),
            "by_order": dict(zip(grey.balance.names, grey.balance.by_order, strict=True)),
            "se": dict(zip(grey.balance.names, grey.balance.se, strict=True)),
        },
        "loop": grey.loop and _loop(grey.loop),
        "unidentifiable": [str(u) for u in grey.fit.unidentifiable],
        "at_bound": grey.fit.at_bound,
        "noise": {
            "force_psd": grey.fit.noise.force_psd,
            "output_variance": grey.fit.noise.output_variance,
        },
        "validation": [
            {
                "record": v.record,
                "metric": v.metric,
                "horizon_s": v.horizon_s,
                "percent": v.error_percent,
                "one_step_percent": v.one_step_percent,
                "force_percent": v.force_percent,
                "fit_percent": v.fit_percent,
                "error_rms": v.error_rms,
                "floor_rms": v.floor_rms,
                "whiteness_p_value": v.whiteness.p_value,
            }
            for v in grey.validations
        ],
    }


def _shape(shape: ModeShape) -> dict[str, Any]:
    return {
        "motion": shape.shape,
        "se": shape.se,
        "sensors_m": shape.sensors_m,
        "rigid": shape.rigid,
        "single": shape.single,
        "drive_by_coil": shape.reach,
        "coils_m": shape.coils_m,
        "agreement_with_wrench": shape.agreement,
    }


def _loop(loop: FittedLoop) -> dict[str, Any]:
    band, fit = loop.band, loop.fit
    modes = []
    for mode, shape in loop.modes:
        frequency_se_hz, damping_se = fit.mode_errors(mode)
        modes.append(
            {
                "kind": mode.kind,
                "frequency_hz": mode.freq_hz,
                "frequency_se_hz": frequency_se_hz,
                "damping": mode.damping,
                "damping_se": damping_se,
                "strength": mode.strength,
                "shape": None if shape is None else _shape(shape),
            }
        )
    return {
        "valid_band": {
            "end_hz": band.end_hz,
            "low_hz": band.low_hz,
            "high_hz": band.high_hz,
            "share": band.share,
            "complete": band.complete,
            "by_mode": band.by_mode,
        },
        "modes": modes,
        "over_noise": loop.over_noise,
        "white": fit.white,
        "worst": {"standard_deviations": fit.worst, "frequency_hz": fit.worst_hz},
        "unexplained": loop.unexplained,
    }
