"""Trace logs of a rig, or of any model with a scheduling variable, by their prediction errors."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..identification.trace.figure_data import Views, views
from ..identification.trace.found_effects_summary import outcome, summary
from ..identification.trace.run_trace import Trace as Result
from ..identification.trace.run_trace import trace
from ..identification.trace.traced_model import model_after
from ..identification.trace.worker_pool import cluster_workers, local_workers
from ..model.effects.candidate_effects import all_effects
from .model_file_errors import naming_the_file
from .read_only_arrays import with_read_only_arrays
from .trace import Trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..config.model import ModelConfig
    from ..identification.trace.worker_pool import Workers
    from .session import Progress, Session, Warn


def trace_rig_logs(
    session: Session,
    config: ModelConfig,
    file: Path | None,
    workers: int | None,
    dask: str | None,
    report: Progress,
    say: Warn,
) -> RigTrace:
    """Trace the session's logs with the model `config`, read from `file`.

    An error in the figures' data is kept, and raised by those who need them: the results of a long
    search survive it.

    Raises:
        ConfigError: the model file does not fit the logs.
        IdentificationError: the logs cannot be traced.
        ImportError: `dask` is given, and the package distributed is not installed.
    """
    with _workers(config, workers, dask, say) as spread:
        with naming_the_file(file):
            found = trace(session.logs, config, all_effects, spread, report)
        report("residual", 1.0)
        drawn: Views | Exception
        try:
            drawn = views(found, spread)
        except Exception as error:  # noqa: BLE001 - raised by those who need them
            drawn = error
    return RigTrace(session, found, drawn)


class RigTrace(Trace):
    """The trace of a rig's logs."""

    def __init__(self, session: Session, found: Result, drawn: Views | Exception) -> None:
        """Hold the result, and the data of its figures or the error in them."""
        super().__init__(session)
        self._found, self._drawn = found, drawn

    @cached_property
    def results(self) -> Result:
        """The result as computed; not a part of the stable API."""
        return with_read_only_arrays(self._found)

    @property
    def _views(self) -> Views:
        if isinstance(self._drawn, Exception):
            raise self._drawn
        return self._drawn

    @property
    def answer(self) -> str:
        """The result in sentences that anyone at the rig understands."""
        from ..report.trace.answer import rig_answer

        return rig_answer(outcome(self._found))

    def _summary(self) -> dict[str, Any]:
        return summary(self._found)

    def _model_after(self) -> ModelConfig:
        return model_after(self._found)

    def _write_page(self, out: Path, command: str) -> Path:
        from ..report.trace.trace_page import trace_report

        return trace_report(self._found, self._views, out, command, self._session.logs)

    def _draw_errors(self) -> Figure:
        from ..report.trace.trace_figures import errors_by_record

        found, result = self._found, outcome(self._found)
        floor = np.array([e.pose_floor for e in found.after])
        before, after = (
            np.sqrt(np.array([e.pose_squares for e in errors]) / floor)
            for errors in (found.before, found.after)
        )
        names = [e.name for e in found.after]
        return errors_by_record(
            names, list(found.places.dof), before if result.effects else None, after
        )

    def _draw_effect(self, number: int) -> Figure | None:
        from ..report.trace.effect_sections import effect_figure

        effects = outcome(self._found).effects
        if number >= len(effects):  # a random force has no shape
            return None
        return effect_figure(effects[number], self._views)


def _workers(
    config: ModelConfig, processes: int | None, dask: str | None, say: Warn
) -> AbstractContextManager[Workers]:
    if dask is None:
        return local_workers(config, processes, say)
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise ImportError(
            "expected the package distributed, found none; run: pip install 'levid[cluster]'",
            name="distributed",
        ) from None
    return cluster_workers(config, dask, say)
