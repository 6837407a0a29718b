"""Fit the declared model to records of a rig: by spectra where the schedule rests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...config.model import ModelConfig
from ..loop_spectra.measured_noise import noise_spectrum
from ..loop_spectra.output_errors import without_transients
from ..records.record import IdentificationError
from ..records.varying_signals import varying
from .experiment.experiment_from_log import Experiment
from .fit import Fit
from .free_parameters import free_parameters
from .modes.identify_in_loop import LoopFit, identify_in_loop
from .modes.lines_by_point import lines_by_point
from .modes.mode import Mode
from .modes.mode_shapes import ModeShape, mode_shapes
from .modes.valid_band import ValidBand, valid_band
from .moving_records import determined

_AT_BOUND = 1e-2
"""Distance from a bound, in standard errors, from which a parameter is on it."""


@dataclass(frozen=True)
class FittedLoop:
    """The spectra, modes and noise of records in a loop, and the declared model's valid band.

    over_noise: largest simulation error of an output in a record, with all modes and at all
    frequencies, over the noise; of rows that were not fitted, if any are held out. unexplained:
    share of an output that neither the model nor a mode explains where that is clearest.
    """

    fit: LoopFit
    band: ValidBand
    over_noise: float
    shapes: tuple[ModeShape | None, ...]
    """Shapes over the sensors of the fit's modes, in their order; None where none is seen."""

    @property
    def modes(self) -> tuple[tuple[Mode, ModeShape | None], ...]:
        """The modes beside the declared model with their shapes, by frequency."""
        pairs = zip(self.fit.modes, self.shapes, strict=True)
        return tuple(sorted(pairs, key=lambda pair: pair[0].omega))

    @property
    def unexplained(self) -> float:
        """Share of the output at the frequency where most is unexplained."""
        shares = []
        for point, found in zip(self.fit.points, self.fit.residuals, strict=True):
            line = int(np.argmin(np.abs(point.freq_hz - self.fit.worst_hz)))
            shares.append(float(found.clear_error[line].max()))
        return float(np.sqrt(max(shares)))


def shows_loop(e: Experiment) -> bool:
    """Return whether a record of the rig excites its loop while the schedule rests."""
    if e.loop is None or e.correlations is None or e.moving:
        return False
    return bool(varying(e.loop.v).any())


def fit_in_loop(
    config: ModelConfig,
    experiments: Sequence[Experiment],
    held_out: Sequence[Experiment],
    band_hz: tuple[float, float] | None,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Fit, FittedLoop]:
    """Fit records of the rig, some of which excite a loop at rest.

    These and still records give their parameters by spectra. What they do not determine, records
    with a moving schedule may (`determined`). Records of single coils count only without others:
    their forces drive shapes that the wrench does not.

    `held_out`: rows kept aside, empty for none.

    Raises IdentificationError as identify_in_loop does.
    """
    rest = [e for e in experiments if e.loop is not None and not e.moving]
    by_wrench = [e for e in rest if not e.by_coil]
    if any(map(shows_loop, by_wrench)):
        rest = by_wrench
    found = identify_in_loop(config, rest, band_hz, progress)
    known = determined(config, found, [e for e in experiments if e.moving])
    free, model = known.free, known.model
    p = free_parameters(config)
    bounds = p.only([p.names.index(name) for name in free])
    values = np.array([model.values[name] for name in free])
    edge = _AT_BOUND * np.sqrt(np.diag(known.covariance))
    at_bound = (values - bounds.low < edge) | (bounds.high - values < edge)
    fit = Fit(
        model,
        free,
        known.covariance,
        known.unidentifiable,
        tuple(name for name, is_at in zip(free, at_bound, strict=True) if is_at),
        found.noise,
        tuple(experiments),
        found.white,
        found.steps,
        _with_held(found) if known.unidentifiable == found.unidentifiable else None,
    )
    names = {e.name for e in rest}
    compared = [e for e in held_out or experiments if e.name in names and not e.moving]
    whole = replace(found, plant=replace(found.plant, model=model))
    return fit, FittedLoop(
        whole, valid_band(found), _over_noise(found, compared), mode_shapes(found, rest)
    )


def _with_held(found: LoopFit) -> tuple[tuple[str, ...], NDArray[np.float64]] | None:
    """Return all declared parameters and their covariance, held ones with the declared value's."""
    if not found.unidentifiable:
        return None
    names = tuple(name for name in found.names if isinstance(name, str))
    return names, found.covariance[: len(names), : len(names)]


def _over_noise(fit: LoopFit, experiments: Sequence[Experiment]) -> float:
    """Return the largest error of the fitted plant over the noise, of all records and outputs."""
    freq_hz = fit.points[0].freq_hz
    try:
        points = lines_by_point(experiments, (float(freq_hz[0]), float(freq_hz[-1])))
    except IdentificationError:
        points = fit.points  # a quarter of a record has too few lines in a narrow band
    levels = {
        record.name: level
        for point, found in zip(fit.points, fit.residuals, strict=True)
        for record, level in zip(point.records, found.levels.tolist(), strict=True)
    }
    ratios = []
    for point in points:
        noise = noise_spectrum(fit.plant, point, fit.noise)
        expected = np.einsum("fii->i", noise).real
        errors = without_transients(fit.plant, point, [noise] * len(point.records))
        for record, E in zip(point.records, errors, strict=True):
            power = np.sum(np.abs(E) ** 2, axis=0)
            ratios.append(np.sqrt(power / (expected * levels.get(record.name, 1.0))))
    return float(np.max(ratios))
