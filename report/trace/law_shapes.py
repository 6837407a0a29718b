"""Sample a found law over the signal that it depends on, fitted and measured."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ...identification.trace.force_balance.force_record import ForceModel, ForceRecord
from ...identification.trace.force_trace.found_law import FoundLaw
from ...identification.trace.force_trace.trace_imported import ForceTrace
from ...identification.trace.residual.binned_means import dependence
from .effect_shapes import Shape

Array = NDArray[np.float64]

_ENOUGH = 0.3
"""Share of a law that one signal must explain to be drawn over it."""
_STRETCH_PERIODS = 800.0
"""Length of the part over time, in periods of the band's limit."""
_SEEN = 0.05
"""Least size of a drawn part, over the law's largest part."""


def law_shapes(trace: ForceTrace, law: FoundLaw) -> list[Shape]:
    """Return the law at each DOF where it acts, over the signal that explains most of it.

    Measured: what the model without the law lacks. Both are free of each record's mean.
    """
    point, shapes = trace.found.point, []
    parts = [_fitted_and_measured(point, law, r) for r in trace.fitted]
    sizes = np.sqrt(np.mean(np.concatenate([f for f, _ in parts]) ** 2, axis=0))
    for i, name in enumerate(trace.places.dof):
        if not sizes[i] > _SEEN * sizes.max():
            continue
        fitted = np.concatenate([f[:, i] for f, _ in parts])
        measured = np.concatenate([m[:, i] for _, m in parts])
        block = _block_numbers(trace)
        best = max(
            (
                (dependence(x, fitted, block).share, what, unit, x)
                for what, unit, x in _signals(trace)
            ),
            key=lambda found: found[0],
        )
        share, what, unit, signal = best
        if not share > _ENOUGH:
            continue
        seen, drawn = (dependence(signal, values, block) for values in (measured, fitted))
        first = trace.fitted[0]
        rows = slice(0, min(first.rows, int(_STRETCH_PERIODS)))
        shapes.append(
            Shape(
                f"force at {name}",
                trace.places.force_unit(i),
                what,
                unit,
                seen.at,
                seen.mean,
                seen.error,
                drawn.mean,
                first.name,
                first.time_s[rows],
                parts[0][1][rows, i],
                parts[0][0][rows, i],
            )
        )
    return shapes


def _block_numbers(trace: ForceTrace) -> NDArray[np.int64]:
    """Return the number of the block of time of each row of all records."""
    count = max(trace.options.blocks // len(trace.fitted), 2)
    return np.concatenate(
        [np.arange(r.rows) * count // r.rows + k * count for k, r in enumerate(trace.fitted)]
    )


def _fitted_and_measured(
    point: ForceModel, law: FoundLaw, record: ForceRecord
) -> tuple[Array, Array]:
    placed = next(p for p in point.placed if p.effect.identity == law.placed.effect.identity)
    forces = record.effect_forces(point, placed.effect, placed.shape)
    fitted = np.tensordot(np.array(placed.amplitudes), forces, 1)
    fitted = record.varying(fitted)
    return fitted, fitted + record.varying(record.missing_force(point))


def _signals(trace: ForceTrace) -> Iterator[tuple[str, str, Array]]:
    """Yield name, unit and samples of all records' positions, speeds and commands, and of the
    relative positions and speeds at joints."""
    for joint in trace.places.joints:
        for order, name, unit in ((0, joint.name, joint.unit), (1, "", f"{joint.unit}/s")):
            values = np.concatenate([r.kept[order] @ joint.motion for r in trace.fitted])
            yield name or f"({joint.name})'", unit, values
    for i, (name, unit) in enumerate(zip(trace.places.dof, trace.places.dof_units, strict=True)):
        yield name, unit, np.concatenate([r.kept[0][:, i] for r in trace.fitted])
        yield f"{name}'", f"{unit}/s", np.concatenate([r.kept[1][:, i] for r in trace.fitted])
    for k, axis in enumerate(trace.config.inputs):
        commands = [r.signals.acting(r.signals.coil)[r.band.kept, k] for r in trace.fitted]
        yield axis.name, axis.unit, np.concatenate(commands)
