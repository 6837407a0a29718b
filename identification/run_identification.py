"""Identify a set of logs by every method that its records allow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from ..config.model import ModelConfig
from ..log.errors import LogError
from ..log.reader import Log, read_log
from .checks_before_fit import check_before_fit
from .greybox.declared_model_from_config import declared_model
from .greybox.experiment.experiment_from_log import Experiment
from .greybox.free_parameters import free_parameters
from .greybox.identify_greybox import DECLARE_LOOP, GreyBox, identify_grey_box
from .identify import identify
from .nonparametric.records_without_a_model import why_no_model
from .nonparametric.robust_multisine import (
    BestLinearApproximation,
    at_every_position,
    by_position_and_level,
)
from .options import Options
from .record_threads import record_threads
from .records.duplicate_logs import DuplicateCheck, identity
from .records.from_log import from_log
from .records.periodic_records import (
    IncompleteError,
    NotPeriodicError,
    PeriodicRecord,
    periodic_record,
)
from .records.record import IdentificationError, NotARecordError, Record, describe_position
from .records.rig_model import no_model
from .records.singular_equations import singular_equations
from .records.varying_signals import varying
from .results import ClosedLoopPoint, IdentificationResult, OpenLoopPoint
from .trace.force_checks.columns_in_another_unit import common_factor
from .trace.force_trace.column_hint import column_hint
from .trace.subtract_declared_effects import experiment_of

Progress = Callable[[str, float], None]
COMPARE_COLUMNS = (
    "Compare columns, signs and units in the signals file with the rig, import and identify again"
)


@dataclass(frozen=True)
class Study:
    """The results of all methods.

    `points`: Markov parameters, Ho-Kalman, subspace and spectra by operating point; None without
    suitable records. `multisine`: the best linear approximation by operating point. `grey`: the
    declared model fitted to all records; None without a model. `notes`: logs left out, with the
    reason, and models that should not be used. `before`: those known before the fits.
    """

    points: IdentificationResult | None
    multisine: tuple[BestLinearApproximation, ...]
    grey: GreyBox | None
    notes: tuple[str, ...] = ()
    before: tuple[str, ...] = ()


@dataclass
class _LogContents:
    records: list[Record] = field(default_factory=list)
    periodic: list[PeriodicRecord] = field(default_factory=list)
    experiments: list[Experiment] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    errors: list[IdentificationError] = field(default_factory=list)
    unfitted: list[str] = field(default_factory=list)
    """Logs that the fit of the declared model cannot use, with the reason."""
    undeclared: list[str] = field(default_factory=list)
    """Why logs of a rig have no declared model."""

    def add(self, more: _LogContents) -> None:
        """Add the contents of further logs."""
        for own in fields(self):
            getattr(self, own.name).extend(getattr(more, own.name))


def study(
    logs: Sequence[Path],
    model_of: Callable[[Log], ModelConfig | None],
    options: Options,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
) -> Study:
    """Read the logs and identify them by every method that their records allow.

    `model_of` returns the declared model for the first log, or None to fit none. The model's lag
    replaces options.lag_s. `say` is called with each remark of the checks before the fit.

    Raises LogError for a file that is not a log, IdentificationError if no method succeeds.
    """
    report = progress or (lambda _what, _share: None)
    found, model = _read(logs, model_of, lambda what, share: report(what, 0.15 * share))
    if model is not None:
        options = replace(options, lag_s=declared_model(model).at().lag_s)
    if not (found.records or found.periodic or found.experiments):
        if found.errors:
            raise found.errors[0]
        raise IdentificationError(
            "expected at least one record to identify, found none: "
            + "; ".join((*found.reasons, *found.undeclared))
        )
    before = (*found.undeclared, *_checks(found, model, options))
    if say is not None:
        for remark in before:
            say(remark)
    points, grey = None, None
    errors: list[IdentificationError] = []
    skipped = tuple(found.reasons)
    notes = list(skipped)
    if found.records:
        try:
            points = identify(
                found.records,
                options,
                lambda what, share: report(what, 0.15 + 0.35 * share),
                skipped,
            )
            notes = [*points.skipped, *_doubt_notes(points)]
        except IdentificationError as error:
            errors.append(error)
            notes.append(f"no Markov parameters: {error}")
    multisine, errors_found = _multisine(found.periodic)
    errors += errors_found
    notes += [f"no best linear approximation: {error}" for error in errors_found]
    if model is not None and found.experiments:
        grey, unfitted = _grey_box(model, found, logs, options, report)
        if unfitted is not None:
            if points is None and not multisine:
                raise (errors[0] if errors and not unfitted.columns else unfitted)
            notes.append(f"the declared model was not fitted: {unfitted}")
            points = _with_doubt(points, unfitted.columns)
        else:
            notes += _effects_note(model)
    if errors and points is None and grey is None and not multisine:
        others = "".join(f"; {reason}" for reason in found.unfitted[:1])
        raise IdentificationError(f"{errors[0]}{others}")
    return Study(points, multisine, grey, (*before, *notes), before)


class _NotFittedError(IdentificationError):
    """Why the declared model was not fitted; columns: what columns have to be for it, or empty."""

    def __init__(self, reason: IdentificationError, columns: str) -> None:
        hint = f"it looks as if {columns}. {COMPARE_COLUMNS}" if columns else ""
        super().__init__(f"{reason}; {hint}" if hint else str(reason))
        self.columns = hint


def _grey_box(
    model: ModelConfig,
    found: _LogContents,
    logs: Sequence[Path],
    options: Options,
    report: Progress,
) -> tuple[GreyBox | None, _NotFittedError | None]:
    """Fit the declared model to the records, or return why it was not fitted.

    Columns in another unit or with another sign may be why: the rig's logs have fixed columns.
    """
    imported = all(e.correlations is None for e in found.experiments)
    try:
        with singular_equations("the fit of the declared model"):
            grey = identify_grey_box(
                model,
                found.experiments,
                options.holdout,
                lambda what, share: report(f"fit, {what}", 0.5 + 0.5 * share),
                options.band_hz,
            )
    except IdentificationError as error:
        return None, _NotFittedError(error, _column_hint(logs, model) if imported else "")
    if not imported:
        return grey, None
    grey = replace(grey, doubts=why_no_model(found.records))
    return _with_column_hint(grey, logs, model), None


def _with_column_hint(grey: GreyBox, logs: Sequence[Path], model: ModelConfig) -> GreyBox:
    """Return the fit with what columns have to be for the model to explain the records.

    A fit of wrong columns may drift, and then seems to need a loop: that remark leads astray.
    """
    free = free_parameters(model)
    fitted = np.array([grey.fit.values[name] for name in free.names])
    in_proportion = common_factor(fitted, free.prior_mean) == 1.0
    if in_proportion and grey.fit.white and not grey.explains_nothing:
        return grey
    columns = _column_hint(logs, model)
    if not columns:
        return grey
    remarks = tuple(text for text in grey.remarks if not text.endswith(DECLARE_LOOP))
    return replace(grey, columns=columns, remarks=remarks)


def _column_hint(logs: Sequence[Path], model: ModelConfig) -> str:
    """Return what columns have to be for the model to explain the records; empty for nothing."""
    try:
        with singular_equations("columns"):
            exchange = column_hint(logs, model)
    except IdentificationError:
        return ""  # too short or too quiet to tell
    return "" if exchange is None else exchange.words


def _with_doubt(found: IdentificationResult | None, doubt: str) -> IdentificationResult | None:
    """Return the result with a doubt about the models of records without a known controller."""
    if found is None or not doubt:
        return found
    points = tuple(
        replace(p, doubts=(doubt, *p.doubts)) if isinstance(p, OpenLoopPoint) else p
        for p in found.points
    )
    return replace(found, points=points)


def _checks(found: _LogContents, model: ModelConfig | None, options: Options) -> tuple[str, ...]:
    """Return the remarks on imported data; logs of the rig have a known loop and excitation."""
    records = [r for r in found.records if r.controller is None]
    experiments = [e for e in found.experiments if e.correlations is None]
    return check_before_fit(records, experiments, model, options)


def _read(
    logs: Sequence[Path], model_of: Callable[[Log], ModelConfig | None], report: Progress
) -> tuple[_LogContents, ModelConfig | None]:
    """Read every log once, and return the contents and the declared model."""
    found, duplicates = _LogContents(), DuplicateCheck()
    if not logs:
        return found, None
    first = read_log(logs[0])
    model = model_of(first)
    if model is None and "rig.yaml" in first.attachments:
        found.undeclared.append(no_model(first))
    repeated = [duplicates.repeated_path(path) for path in logs]

    def contents(number: int) -> tuple[object, _LogContents] | None:
        if repeated[number] is not None:
            return None
        log = read_log(logs[number]) if number else first
        return identity(log), _contents(log, model)

    with record_threads() as pool:
        every = pool.map(contents, range(len(logs)))
        for number, (path, remark, one) in enumerate(zip(logs, repeated, every, strict=True)):
            report(path.name, (number + 1) / len(logs))
            duplicate = remark or (None if one is None else duplicates.copy_of(path, one[0]))
            if duplicate is not None:
                found.reasons.append(duplicate)
            elif one is not None:
                found.add(one[1])
    return found, model


def _multisine(
    records: Sequence[PeriodicRecord],
) -> tuple[tuple[BestLinearApproximation, ...], list[IdentificationError]]:
    """Return the approximations, and the errors at other positions and levels."""
    found: list[BestLinearApproximation] = []
    errors_found = []
    for group in by_position_and_level(records):
        try:
            found += at_every_position(group)
        except IdentificationError as error:
            errors_found.append(error)
    return tuple(found), errors_found


def _effects_note(model: ModelConfig) -> list[str]:
    if not model.effects:
        return []
    names = ", ".join(" ".join((e.effect, "at", *e.where)) for e in model.effects)
    return [
        f"declared model: its effects ({names}) keep the values of the model file, only the other "
        "parameters are fitted; 'levid trace' fits both"
    ]


def _doubt_notes(result: IdentificationResult) -> list[str]:
    found = []
    for point in result.points:
        if not isinstance(point, ClosedLoopPoint):
            found += [f"do not use the black-box model: {doubt}" for doubt in point.doubts]
            continue
        by_method = {"Ho-Kalman": point.doubts}
        if point.subspace is not None:
            by_method["subspace"] = point.subspace.doubts
        found += [
            f"{describe_position(point.beam_m)}: do not use the {method} model: {'; '.join(doubts)}"
            for method, doubts in by_method.items()
            if doubts
        ]
    return found


def _contents(log: Log, model: ModelConfig | None) -> _LogContents:
    """Return the input that a log is to the methods, or why it is none."""
    found = _LogContents()
    try:
        _sort_log(log, model, found)
    except IdentificationError as error:
        found.reasons.append(str(error))
        found.errors.append(error)
    return found


def _sort_log(log: Log, model: ModelConfig | None, found: _LogContents) -> None:
    """Add a log to the input of every method that can use it; if there is none, note the reason."""
    reason: NotARecordError | None = None
    try:
        if not _add_periodic(log, found):
            found.records.append(from_log(log))
    except NotARecordError as error:
        reason = error
    if model is not None:
        try:
            experiment = experiment_of(log, model)
            found.experiments.append(experiment)
            still = np.flatnonzero(~varying(experiment.y))
            found.reasons += [
                f"{log.path.name}: {model.dof[i].name} is constant over the record, so its noise "
                "is unknown; check the sensor's connection"
                for i in still.tolist()
            ]
            return
        except NotARecordError as error:
            reason = error
        except (IdentificationError, LogError) as error:
            if reason is not None:
                raise
            found.unfitted.append(f"not used for the declared model: {error}")
            found.reasons.append(found.unfitted[-1])
    if reason is not None:
        found.reasons.append(str(reason))


def _add_periodic(log: Log, found: _LogContents) -> bool:
    """Add the log if it is a record of orthogonal multisines; return whether it is one.

    An incomplete one is noted: the fit of the declared model may still use it. Markov parameters
    cannot, as its excitation repeats.
    """
    if "session.yaml" not in log.attachments:
        return False
    try:
        found.periodic.append(periodic_record(log))
    except IncompleteError as error:
        found.reasons.append(str(error))
    except NotPeriodicError:
        return False
    return True
