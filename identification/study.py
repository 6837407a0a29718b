"""All that identification can say of a set of logs, every method on the records that suit it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..config.model import ModelConfig
from ..log.errors import LogError
from ..log.reader import Log, read_log
from .greybox.experiment import Experiment
from .greybox.identify_greybox import GreyBox, identify_grey_box
from .greybox.model_file import declared_model
from .identify import identify
from .nonparametric.robust_multisine import (
    BestLinearApproximation,
    at_every_position,
    by_position_and_level,
)
from .options import Options
from .records.duplicates import Once
from .records.from_log import from_log
from .records.periodic_records import (
    IncompleteError,
    NotPeriodicError,
    PeriodicRecord,
    periodic_record,
)
from .records.record import IdentificationError, NotARecordError, Record, describe_position
from .results import ClosedLoopPoint, IdentificationResult
from .trace.subtract_effects import experiment_of

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Study:
    """What was found.

    `points`: Markov parameters, Ho-Kalman and spectra by operating point; None without records that
    suit them. `multisine`: the best linear approximation by operating point. `grey`: the declared
    model fitted to all records; None without a model. `notes`: what was left out, and why, and
    which models are not to be trusted.
    """

    points: IdentificationResult | None
    multisine: tuple[BestLinearApproximation, ...]
    grey: GreyBox | None
    notes: tuple[str, ...] = ()


@dataclass
class _Sorted:
    records: list[Record]
    periodic: list[PeriodicRecord]
    experiments: list[Experiment]
    reasons: list[str]
    errors: list[IdentificationError]


def study(
    logs: Sequence[Path],
    model_of: Callable[[Log], ModelConfig | None],
    options: Options,
    progress: Progress | None = None,
) -> Study:
    """Read `logs` one by one and identify by every method that their records allow.

    `model_of` gives the declared model for the first log, None where none is to be fitted. Its lag
    is taken out of a loop before the loop is realised, instead of options.lag_s.

    Raises LogError for a file that is no log, IdentificationError where nothing can be identified.
    """
    tell = progress or (lambda _what, _share: None)
    found, model = _read(logs, model_of, lambda what, share: tell(what, 0.15 * share))
    if model is not None:
        options = replace(options, lag_s=declared_model(model).at().lag_s)
    if not (found.records or found.periodic or found.experiments):
        if found.errors:
            raise found.errors[0]
        raise IdentificationError(
            f"expected at least one record to identify, found none: {'; '.join(found.reasons)}"
        )
    points, grey = None, None
    failed: list[IdentificationError] = []
    skipped = tuple(found.reasons)
    notes = list(skipped)
    if found.records:
        try:
            points = identify(
                found.records,
                options,
                lambda what, share: tell(what, 0.15 + 0.35 * share),
                skipped,
            )
            notes = [*points.skipped, *_distrusted(points)]
        except IdentificationError as error:
            failed.append(error)
            notes.append(f"no Markov parameters: {error}")
    multisine, refused = _multisine(found.periodic)
    failed += refused
    notes += [f"no best linear approximation: {error}" for error in refused]
    if model is not None and found.experiments:
        try:
            grey = identify_grey_box(
                model,
                found.experiments,
                options.holdout,
                lambda what, share: tell(f"fit, {what}", 0.5 + 0.5 * share),
            )
            notes += _freed(model)
        except IdentificationError as error:
            if points is None and not multisine:
                raise (failed[0] if failed else error) from None
            notes.append(f"the declared model was not fitted: {error}")
    if failed and points is None and grey is None and not multisine:
        raise failed[0]
    return Study(points, multisine, grey, tuple(notes))


def _read(
    logs: Sequence[Path], model_of: Callable[[Log], ModelConfig | None], tell: Progress
) -> tuple[_Sorted, ModelConfig | None]:
    """Return what the logs hold, each used once however often it is given, and the model."""
    found, model = _Sorted([], [], [], [], []), None
    once = Once()
    for number, path in enumerate(logs):
        tell(path.name, number / len(logs))
        twice = once.again(path)
        if twice is None:
            log = read_log(path)
            model = model_of(log) if number == 0 else model
            twice = once.copied(path, log)
        if twice is not None:
            found.reasons.append(twice)
            continue
        try:
            _sort(log, model, found)
        except IdentificationError as error:
            found.reasons.append(str(error))
            found.errors.append(error)
    return found, model


def _multisine(
    records: Sequence[PeriodicRecord],
) -> tuple[tuple[BestLinearApproximation, ...], list[IdentificationError]]:
    """Return the approximations, and why there is none at other positions and levels."""
    found: list[BestLinearApproximation] = []
    refused = []
    for group in by_position_and_level(records):
        try:
            found += at_every_position(group)
        except IdentificationError as error:
            refused.append(error)
    return tuple(found), refused


def _freed(model: ModelConfig) -> list[str]:
    if not model.effects:
        return []
    names = ", ".join(" ".join((e.effect, "at", *e.where)) for e in model.effects)
    return [
        f"the fit of the declared model: its effects ({names}) were taken out of the records at "
        "the values of the model file, and are not fitted; a trace fits both"
    ]


def _distrusted(result: IdentificationResult) -> list[str]:
    found = []
    for point in result.points:
        if not isinstance(point, ClosedLoopPoint):
            continue
        by_method = {"Ho-Kalman": point.doubts}
        if point.subspace is not None:
            by_method["subspace"] = point.subspace.doubts
        found += [
            f"{describe_position(point.beam_m)}: the model by {method} is not to be trusted: "
            f"{'; '.join(doubts)}"
            for method, doubts in by_method.items()
            if doubts
        ]
    return found


def _sort(log: Log, model: ModelConfig | None, found: _Sorted) -> None:
    """Give a log to every method that can use it; what none can use is left out with a reason."""
    reason: NotARecordError | None = None
    try:
        if not _periodic(log, found):
            found.records.append(from_log(log))
    except NotARecordError as error:
        reason = error
    if model is not None:
        try:
            experiment = experiment_of(log, model)
            found.experiments.append(experiment)
            still = np.flatnonzero(np.ptp(experiment.y, axis=0) == 0.0)
            found.reasons += [
                f"{log.path.name}: {model.dof[i].name} shows one value in every row: it says "
                "nothing of the noise, and whether it is connected should be looked at"
                for i in still.tolist()
            ]
            return
        except NotARecordError as error:
            reason = error
        except (IdentificationError, LogError) as error:
            if reason is not None:
                raise
            found.reasons.append(f"not used for the declared model: {error}")
    if reason is not None:
        found.reasons.append(str(reason))


def _periodic(log: Log, found: _Sorted) -> bool:
    """Take a record of orthogonal multisines, as its session tells; say whether it is one.

    One that was cut off too early is noted: the fit of the declared model may still use it, Markov
    parameters, for which it repeats, can not.
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
