"""Find the effects that a model lacks from the logs of a session, and hold the result."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..config.escaping import html_text
from ..identification.records.record import IdentificationError
from ..identification.trace.worker_processes import begin_imports, worker_count
from ..log.catalogue.results import RESULT
from .html_table import Table
from .model import (
    ArgumentError,
    Model,
    ModelSource,
    Parameter,
    Parameters,
    model_config,
    model_of_config,
)
from .output_folder import claimed_folder
from .result_file import REPORT_FILES, REPORT_FOLDERS, save_result, with_origin

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..config.model import ModelConfig
    from ..identification.trace.force_trace.trace_imported import ForceTrace
    from ..identification.trace.run_trace import Trace as RigTraceResult
    from .session import Progress, Session, Warn


def trace(
    session: Session,
    model: ModelSource | None,
    workers: int | None = None,
    dask: str | None = None,
    progress: Progress | None = None,
    warn: Warn | None = None,
) -> Trace:
    """Find the effects that the session's records show and the model lacks.

    Imported records are traced by the force that the model lacks, those of a rig by the errors of
    its predictions.

    Raises:
        ConfigError: the model file is wrong.
        IdentificationError: the logs cannot be traced.
        ImportError: `dask` is given, and the package distributed is not installed.
        LogError: a file is not a log, or the logs are of two rigs.
    """
    session.require_one_plant()
    imported = "signals.yaml" in session.steps[0].attachments
    if not (imported or dask) and worker_count(workers) > 1:
        begin_imports()  # while this process does the same
    from .trace_of_imported import trace_imported_logs
    from .trace_of_rig import trace_rig_logs

    report = progress or (lambda _what, _share: None)
    say = warn or partial(warnings.warn, stacklevel=4)
    config, file = _declared(session, model)
    if imported:
        return trace_imported_logs(session, config, report)
    return trace_rig_logs(session, config, file, workers, dask, report, say)


@dataclass(frozen=True)
class Alternative:
    """An effect that the records do not distinguish from another one; support: 0 to 1."""

    name: str
    kind: str
    where: tuple[str, ...]
    support: float | None


@dataclass(frozen=True)
class FoundEffect:
    """An effect that the records show and the model lacks.

    kind: its class, such as coil_gain; "unknown" for a free form, "ambiguous" if the records do not
    tell it from `alternatives`. where: DOF, coil:N, sensor:N, beam or rotor. support: how stable
    the data's choice of it is, 0 to 1. doubtful: whether its name is uncertain. evidence: the
    object of the JSON, see docs/trace-json.md.
    """

    name: str
    kind: str
    where: tuple[str, ...]
    equation: str
    parameters: Parameters
    support: float | None
    alternatives: tuple[Alternative, ...]
    doubtful: bool
    evidence: Mapping[str, Any]

    def __str__(self) -> str:
        values = "" if self.kind == "unknown" else ", ".join(map(str, self.parameters.values()))
        doubt = " (name uncertain)" if self.doubtful else ""
        return f"{self.name}{': ' if values else ''}{values}{doubt}"


class Effects(tuple[FoundEffect, ...]):
    """The effects of a trace in the order found; displays as a table."""

    __slots__ = ()

    def __repr__(self) -> str:
        return "\n".join(map(str, self)) or "no effects"

    def _repr_html_(self) -> str:
        rows = [
            (
                str(k),
                f"{e.name}{' (name uncertain)' if e.doubtful else ''}",
                e.kind,
                ", ".join(e.where),
                "" if e.kind == "unknown" else ", ".join(map(str, e.parameters.values())),
                "" if e.support is None else f"{e.support:.2f}",
            )
            for k, e in enumerate(self)
        ]
        head = ("", "effect", "kind", "where", "parameters, 95 % intervals", "support")
        return Table(head, rows).html()


@dataclass(frozen=True)
class Validation:
    """Error on held-out records before and after the trace, and the noise floor.

    metric: free_run, prediction or force; `about` says what it measures. before, after: None if the
    error is not a number. noise_floor: None if the records do not separate noise from model
    error. percent_before, percent_after: error over output by DOF, in %. `details`: the object of
    the JSON, see docs/trace-json.md.
    """

    metric: str
    about: str
    before: float | None
    after: float | None
    noise_floor: float | None
    percent_before: Mapping[str, float | None]
    percent_after: Mapping[str, float | None]
    details: Mapping[str, Any]

    def __str__(self) -> str:
        floor = "" if self.noise_floor is None else f", noise floor {self.noise_floor:.3g}"
        before, after = ("?" if e is None else f"{e:.3g}" for e in (self.before, self.after))
        if self.metric == "force":
            return f"missing force {before} % before, {after} % after"
        return f"error over noise {before} before, {after} after{floor}"


class Trace(ABC):
    """The result of a trace: effects, refitted model, errors before and after, plots, report."""

    def __init__(self, session: Session) -> None:
        """Hold the traced session."""
        self._session = session
        self._written: dict[str, Path | None] = {"model": None, "report": None}

    @property
    def model_file(self) -> Path | None:
        """Path of model.yaml; None before `report` or `save` was called."""
        return self._written["model"]

    @property
    def page(self) -> Path | None:
        """Path of the report's page; None before `report` was called."""
        return self._written["report"]

    @property
    def session(self) -> Session:
        """The traced session."""
        return self._session

    @property
    @abstractmethod
    def results(self) -> RigTraceResult | ForceTrace:
        """The result as computed; not a part of the stable API."""

    @property
    def effects(self) -> Effects:
        """The effects found, in the order found; declared effects are in `model`."""
        return Effects(_effect(plain) for plain in self._summary()["effects"])

    @property
    def validation(self) -> Validation:
        """Errors on records that were not used to fit."""
        v = self._summary()["validation"]
        return Validation(
            v["metric"], v["about"], v["before"], v["after"], v["noise_floor"],
            v["percent"]["before"], v["percent"]["after"], v,
        )  # fmt: skip

    @property
    def explained(self) -> float | None:
        """Share of the squared error above noise that the effects explain; None without any error.

        Without a known noise floor, the share of the whole squared error.
        """
        v = self.validation
        if v.before is None or v.after is None:
            return None
        floor = v.noise_floor or 0.0
        there = v.before**2 - floor**2
        return None if there <= 0.0 else min(1.0 - (v.after**2 - floor**2) / there, 1.0)

    @property
    @abstractmethod
    def answer(self) -> str:
        """The result in sentences that anyone at the rig understands."""

    @property
    def verdict(self) -> str:
        """The result in a sentence, with the names of the effects."""
        return str(self._summary()["unexplained"]["found"])

    @property
    def notes(self) -> tuple[str, ...]:
        """Records left out, with the reason, and what limits the result."""
        return tuple(self.results.notes)

    @property
    def model(self) -> Model:
        """The refitted model with the effects; identify, trace and the simulator use it."""
        return model_of_config(self._model_after(), self.results.config)

    @property
    def parameters(self) -> Parameters:
        """Parameters of the refitted model; those of an effect are in `effects`."""
        return self.model.parameters

    def to_json(self) -> dict[str, Any]:
        """Return the object that `levid trace --json` prints: dicts, lists, numbers, text.

        `model` and `report` are the paths of model.yaml and the page, None before `report` was
        called.
        """
        written = {name: None if p is None else str(p) for name, p in self._written.items()}
        plain = {"answer": self.answer, **self._summary(), **written, "notes": list(self.notes)}
        return with_origin("trace", self._session.logs, plain)

    def report(self, folder: str | Path, command: str = "") -> Path:
        """Write the report, result.json, and model.yaml with the effects; return the page.

        The page ends with `command`, which repeats the trace.

        Raises:
            ConfigError: the folder cannot be written.
        """
        out = Path(folder)
        with claimed_folder(out, REPORT_FILES, REPORT_FOLDERS):
            # Save the model first: the results of a long search survive an error in the report.
            self._written["model"] = self.model.save(out / "model.yaml")
            save_result(out, self.to_json())
            page = self._write_page(out, command)
            self._written["report"] = page
            save_result(out, self.to_json())
        return page

    def save(self, folder: str | Path) -> Path:
        """Write model.yaml and result.json to `folder`, without a report; return the folder.

        Raises:
            ConfigError: the folder cannot be written.
        """
        out = Path(folder)
        with claimed_folder(out, ("model.yaml", RESULT)):
            self._written["model"] = self.model.save(out / "model.yaml")
            save_result(out, self.to_json())
        return out

    def plot(self, effect: int | None = None) -> Figure:
        """Draw an effect by number, measured and fitted; default: the errors before and after.

        Raises:
            IdentificationError: there is no effect of this number, or no figure of it.
        """
        from .notebook_figure import shown

        if effect is None:
            return shown(self._draw_errors())
        count = len(self.effects)
        if not -count <= effect < count:
            found = "no effects" if not count else f"effects 0 to {count - 1}"
            raise IdentificationError(f"effect {effect}: the trace has {found}")
        figure = self._draw_effect(effect % count)
        if figure is None:
            raise IdentificationError(
                f"effect {effect}: {self.effects[effect].name} has no figure: no signal of the "
                "records explains enough of it"
            )
        return shown(figure)

    def __iter__(self) -> Iterator[FoundEffect]:
        return iter(self.effects)

    def __len__(self) -> int:
        return len(self.effects)

    def __bool__(self) -> bool:
        return True  # a trace without effects is a result

    def __repr__(self) -> str:
        lines = [f"<Trace of {self._session.name}: {self.verdict}>", f"{self.validation}"]
        return "\n".join([*lines, *map(str, self.effects)])

    def _repr_html_(self) -> str:
        head = f"<p><b>Trace of {html_text(self._session.name)}</b>: {html_text(self.verdict)}</p>"
        table = self.effects._repr_html_() if self.effects else ""
        return f"{head}<p>{html_text(str(self.validation))}</p>{table}"

    @abstractmethod
    def _summary(self) -> dict[str, Any]:
        """Return effects, validation and unexplained as in the JSON."""

    @abstractmethod
    def _model_after(self) -> ModelConfig:
        """Return the refitted model with its effects."""

    @abstractmethod
    def _write_page(self, out: Path, command: str) -> Path:
        """Write the page and its figures to a folder; return its path."""

    @abstractmethod
    def _draw_errors(self) -> Figure:
        """Draw the errors before and after."""

    @abstractmethod
    def _draw_effect(self, number: int) -> Figure | None:
        """Draw an effect, measured and fitted; None if it has no figure."""


def _effect(plain: Mapping[str, Any]) -> FoundEffect:
    parameters = {
        name: Parameter(name, p["value"], p["se"], p["unit"])
        for name, p in plain["parameters"].items()
    }
    evidence = plain["evidence"]
    return FoundEffect(
        plain["name"],
        plain["class"],
        tuple(plain["where"]),
        evidence["equation"],
        Parameters(parameters),
        plain.get("support"),
        tuple(_alternative(a) for a in plain.get("alternatives", [])),
        bool(evidence.get("doubtful", False)),
        evidence,
    )


def _alternative(plain: Mapping[str, Any]) -> Alternative:
    return Alternative(plain["name"], plain["class"], tuple(plain["where"]), plain.get("support"))


def _declared(session: Session, model: ModelSource | None) -> tuple[ModelConfig, Path | None]:
    """Return the model to start from; default: the model of the rig that flew the first log."""
    from ..identification.records.rig_model import no_model, rig_model
    from ..log.reader import read_log

    config, file = model_config(session.model if model is None else model)
    if config is not None:
        return config, file
    log = read_log(session.logs[0])
    config = rig_model(log)
    if config is not None:
        return config, file
    if "rig.yaml" in log.attachments:
        raise ArgumentError(f"expected {{}}: {no_model(log)}", "model", "MODEL.yaml")
    raise ArgumentError(
        f"expected {{}} for {log.path}, which is not a log of the rig; found none",
        "model",
        "MODEL.yaml",
    )
