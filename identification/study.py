"""All that identification can say of a set of logs, every method on the records that suit it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ..config.model import ModelConfig
from ..log.reader import Log, read_log
from .data import IdentificationError, Record
from .declared import declared_model
from .from_log import NotARecordError, from_log
from .greybox.experiment import Experiment, experiment_from_log
from .greybox.result import GreyBox, identify_grey_box
from .identify import identify
from .multisine import BestLinearApproximation, at_every_position
from .options import Options
from .periodic import NotPeriodicError, PeriodicRecord, periodic_record
from .results import IdentificationResult

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Study:
    """What was found.

    `points`: Markov parameters, Ho-Kalman and spectra by operating point; None without a record for
    them. `multisine`: the best linear approximation by operating point. `grey`: the declared model
    fitted to all records; None without a model. `notes`: what was left out, and why.
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
    found, model = _Sorted([], [], [], []), None
    for number, path in enumerate(logs):
        tell(path.name, 0.15 * number / len(logs))
        log = read_log(path)
        model = model if number else model_of(log)
        _sort(log, model, found)
    if model is not None:
        options = replace(options, lag_s=declared_model(model).at().lag_s)
    if not (found.records or found.periodic or found.experiments):
        raise IdentificationError(
            f"expected at least one record to identify, found none: {'; '.join(found.reasons)}"
        )
    points, grey = None, None
    multisine: tuple[BestLinearApproximation, ...] = ()
    if found.records:
        points = identify(
            found.records,
            options,
            lambda what, share: tell(what, 0.15 + 0.35 * share),
            found.reasons,
        )
    if found.periodic:
        multisine = at_every_position(found.periodic)
    notes = list(found.reasons)
    if model is not None and found.experiments:
        try:
            grey = identify_grey_box(
                model,
                found.experiments,
                options.holdout,
                lambda what, share: tell(f"fit, {what}", 0.5 + 0.5 * share),
            )
        except IdentificationError as error:
            if points is None and not multisine:
                raise
            notes.append(f"the declared model was not fitted: {error}")
    return Study(points, multisine, grey, tuple(notes))


def _sort(log: Log, model: ModelConfig | None, found: _Sorted) -> None:
    try:
        if not _periodic(log, found):
            found.records.append(from_log(log))
    except NotARecordError as reason:
        found.reasons.append(str(reason))
    if model is None:
        return
    try:
        found.experiments.append(experiment_from_log(log, model))
    except NotARecordError:
        return  # said already


def _periodic(log: Log, found: _Sorted) -> bool:
    """Take a record of orthogonal multisines, as its session tells; say whether it is one."""
    if "session.yaml" not in log.attachments:
        return False
    try:
        found.periodic.append(periodic_record(log))
    except NotPeriodicError:
        return False
    return True
