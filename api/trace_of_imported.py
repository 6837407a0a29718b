"""Trace imported logs by the force that the model lacks."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..identification.trace.force_trace.force_trace_outcome import force_outcome
from ..identification.trace.force_trace.force_trace_summary import force_summary
from ..identification.trace.force_trace.model_with_effects import model_with_effects
from ..identification.trace.force_trace.trace_imported import ForceTrace, trace_imported
from ..model.effects.candidate_effects import all_effects
from .read_only_arrays import with_read_only_arrays
from .trace import Trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..config.model import ModelConfig
    from .session import Progress, Session


def trace_imported_logs(session: Session, config: ModelConfig, report: Progress) -> ImportedTrace:
    """Trace the session's logs with the model `config`.

    Raises:
        IdentificationError: the logs cannot be traced.
    """
    return ImportedTrace(session, trace_imported(session.logs, config, all_effects, report))


class ImportedTrace(Trace):
    """The trace of imported logs."""

    def __init__(self, session: Session, found: ForceTrace) -> None:
        """Hold the result."""
        super().__init__(session)
        self._found = found

    @cached_property
    def results(self) -> ForceTrace:
        """The result as computed; not a part of the stable API."""
        return with_read_only_arrays(self._found)

    @property
    def answer(self) -> str:
        """The result in sentences that anyone at the rig understands."""
        from ..report.trace.answer import imported_answer

        return imported_answer(force_outcome(self._found))

    def _summary(self) -> dict[str, Any]:
        return force_summary(self._found)

    def _model_after(self) -> ModelConfig:
        return model_with_effects(self._found)

    def _write_page(self, out: Path, command: str) -> Path:
        from ..report.trace.imported_page import imported_report

        return imported_report(self._found, out, command, self._session.logs)

    def _draw_errors(self) -> Figure:
        from ..report.trace.missing_force import missing_force

        return missing_force(self._found)

    def _draw_effect(self, number: int) -> Figure | None:
        from ..report.trace.effect_shapes import effect_shapes
        from ..report.trace.law_shapes import law_shapes

        shapes = law_shapes(self._found, force_outcome(self._found).laws[number])
        return effect_shapes(shapes) if shapes else None
