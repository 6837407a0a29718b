"""Fit a found model with instrumental variables, where least squares is biased.

A force that nothing measures, such as wind, moves the plant too: the columns of a force balance
contain its motion, and least squares takes a part of this force for one of the plant, whose numbers
become too small. Of the causes that are recorded, the inputs or what drives a control loop from
outside, none depends on it: numbers with which the missing force has no part in the columns of
their motion are not biased (Soederstroem and Stoica, *Instrumental variable methods for system
identification*, Springer, 1983). As instruments any signals of the causes will do; here they are
the linear responses of outputs and inputs to them, which needs no model and no stable plant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft
from scipy.signal import csd, fftconvolve

from ....model.declared_model import ModelError
from ...greybox.experiment.intersample_input import Hold
from ...rounding import ROUNDING
from ...subspace.response_uncertainty import SURE_95
from ..force_balance.force_record import ForceModel, force_records
from ..force_balance.free_numbers import moved_by, numbers, way
from ..force_regression.gauss_newton_fit import HALVINGS, gauss_newton_step
from ..force_regression.intervals import Influences
from ..force_regression.residual_whitening import SEGMENTS
from ..force_regression.training_records import Training, missing_share
from ..records.record_from_log import TraceRecord
from ..search_options import SearchOptions

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_CONVERGED = SearchOptions.accuracy**2
"""Of the square that one column takes by chance: no number is a hundredth of its error away."""


def projected(records: Sequence[TraceRecord]) -> tuple[TraceRecord, ...] | None:
    """Return the records with what of their outputs and inputs is linear in known causes.

    The causes are the inputs, in a control loop its references and excitations. Responses to them
    are estimated from the other records, so that a record's random force is not in its own.
    None where a loop has no such signal that varies, or where rates differ.
    """
    causes = [c for r in records if (c := r.experiment.causes) is not None]
    alike = {(r.experiment.Ts_s, c.shape[1]) for r, c in zip(records, causes, strict=False)}
    if len(causes) < len(records) or len(alike) > 1:
        return None
    signals = [np.hstack([r.experiment.y, r.experiment.u]) for r in records]
    rows = min(len(x) for x in signals) // SEGMENTS
    pairs = [_spectra(w, x, rows) for w, x in zip(causes, signals, strict=True)]
    found = []
    for k, (record, w, x) in enumerate(zip(records, causes, signals, strict=True)):
        others = [p for i, p in enumerate(pairs) if i != k] or pairs
        moved = _response(others, w, rows) + x.mean(axis=0)
        y, u = np.split(moved, [record.experiment.y.shape[1]], axis=1)
        if not record.experiment.feedback:
            u = record.experiment.u
        alone = replace(record.experiment, y=y, u=u)
        found.append(replace(record, experiment=alone, gap=y, coil=u))
    return tuple(found)


def _spectra(w: Array, x: Array, rows: int) -> tuple[Complex, Complex]:
    """Return the spectra of causes (F, m, m), and their cross spectra to signals (F, m, c)."""
    both = np.hstack([w, x]).T
    m = w.shape[1]
    whole = csd(both[:m, None], both[None], nperseg=rows)[1] * (len(x) / rows)
    whole = np.moveaxis(whole, 2, 0)
    return whole[:, :, :m], whole[:, :, m:]


def _response(spectra: Sequence[tuple[Complex, Complex]], w: Array, rows: int) -> Array:
    """Return the linear response (N, c) to causes w (N, m), estimated from spectra."""
    of_causes = sum(s for s, _ in spectra)
    size = np.sqrt(np.einsum("fii->i", of_causes).real)
    size = np.where(size > 0.0, size, 1.0)
    scaled = of_causes / np.outer(size, size)
    scaled = scaled + ROUNDING * np.abs(scaled).max() * np.eye(len(size))
    gains = np.linalg.solve(scaled, sum(s for _, s in spectra) / size[:, None]) / size[:, None]
    impulses = np.roll(irfft(gains, rows, axis=0), rows // 2, axis=0)  # (rows, m, c)
    moved = [
        sum(fftconvolve(v, one) for v, one in zip((w - w.mean(axis=0)).T, each, strict=True))
        for each in np.moveaxis(impulses, 0, 2).swapaxes(0, 1)
    ]
    first = rows // 2
    return np.stack(moved, axis=1)[first : first + len(w)]


def instruments_of(
    simulated: Sequence[TraceRecord],
    training: Training,
    hold: Hold,
    law_hz: Sequence[float],
    sd: Array,
) -> Training:
    """Return projected records as those of `training`, in its band and with its weights."""
    limit_hz = training.whitening.cutoff_hz
    return replace(training, records=force_records(simulated, hold, limit_hz, law_hz, sd))


@dataclass(frozen=True)
class Unbiased:
    """A model fitted with instruments, these, and the same model fitted so in other bands.

    large: whether it misses more force than the error of an equation may be. What is smaller need
    not be a random force: both fits are then as wrong as the equation, and nothing tells which of
    them more.
    """

    point: ForceModel
    instruments: Training
    others: tuple[ForceModel, ...]
    large: bool

    @classmethod
    def of(
        cls,
        point: ForceModel,
        training: Training,
        others: Sequence[Training],
        records: Sequence[TraceRecord],
        hold: Hold,
        law_hz: Sequence[float],
        sd: Array,
        options: SearchOptions,
    ) -> Unbiased | None:
        """Return the fit with instruments; None without these, or if `point` may be as right.

        point: the fit by least squares, whose numbers are better known where they are not biased.
        others: the records in other bands. An equation that holds times any factor has no bias.
        """
        if np.any(np.isfinite(training.reference)):
            return None
        alone = projected(records)
        if alone is None:
            return None
        instruments = instruments_of(alone, training, hold, law_hz, sd)
        found = fit_with_instruments(point, training, instruments)
        if found is None or not _contradicts(found, instruments, point, training):
            return None
        pairs = [(other, instruments_of(alone, other, hold, law_hz, sd)) for other in others]
        fits = [fit_with_instruments(found, *pair) for pair in pairs]
        missing = missing_share(training.plain.at(point)).max()
        large = bool(missing > options.least_force)
        return cls(found, instruments, tuple(f for f in fits if f is not None), large)


def _contradicts(
    found: ForceModel, instruments: Training, point: ForceModel, training: Training
) -> bool:
    """Return whether a fit with instruments is away from one by least squares by more than chance
    (Hausman, *Specification tests in econometrics*, Econometrica 46, 1978)."""
    pair = (found, training, instruments), (point, training)
    one, other = (Influences.of(*each) for each in pair)
    apart = np.abs(numbers(found) - numbers(point))
    chance = np.linalg.norm(one.by_block - other.by_block, axis=0)
    return bool(np.any(apart[~other.silent] > SURE_95 * chance[~other.silent]))


def fit_with_instruments(
    point: ForceModel, training: Training, instruments: Training
) -> ForceModel | None:
    """Return the model whose missing force has no part in the instruments' columns.

    None if more of it is left there than by chance in one of them.
    """
    begin = point
    for _ in range(SearchOptions.steps):
        step, part = gauss_newton_step(training, point, way(begin, point), instruments)
        left = float(part @ part)
        chance = float(training.at(point).squares.sum()) / training.independent
        if left < _CONVERGED * chance:
            return point
        for halving in range(HALVINGS):
            moved = moved_by(point, step * 0.5**halving)
            if _part_left(training, moved, begin, instruments) < left:
                point = moved
                break
        else:
            return point if left < chance else None
    return None


def _part_left(
    training: Training, point: ForceModel, begin: ForceModel, instruments: Training
) -> float:
    """Return the squares of the missing force's part in the instruments' columns, infinite for
    parameters whose mass matrix has no inverse."""
    try:
        _, part = gauss_newton_step(training, point, way(begin, point), instruments)
    except ModelError:
        return float("inf")
    return float(part @ part)
