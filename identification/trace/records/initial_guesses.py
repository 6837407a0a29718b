"""Estimate initial guesses for the search: spectral lines, resonances, and the range of motion."""

from __future__ import annotations

from collections.abc import Sequence

from ....model.effects.operating_range import Extent
from .dof_resonances import dof_resonances
from .effect_signals import trajectory
from .record_from_log import TraceRecord
from .resonances import resonances
from .spectral_lines import spectral_lines


def extent(records: Sequence[TraceRecord]) -> Extent:
    """Return the records' range of motion, the lines in still ones, and the resonances."""
    signals = [trajectory(r, r.experiment.y, r.coil, 0.0) for r in records]
    loose = tuple((r.dof, r.frequency_hz, r.damping) for r in dof_resonances(records))
    return Extent.measured(signals, spectral_lines(records), resonances(records), loose)
