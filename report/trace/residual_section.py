"""Build the report section on the residual: dependence on signals, over time, by sensor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...identification.trace.figure_data import RecordView, Views
from ...identification.trace.residual.binned_means import Dependence, dependence
from ...identification.trace.run_trace import Trace
from ...identification.trace.trace_outcome import Outcome
from ..plotting.figure_to_svg import Picture, to_svg
from ..plotting.html_page import Part, Section, Text
from ..plotting.labelled_frequency_responses import symbol
from ..plotting.number_format import amount, signal_text
from .trace_figures import dependence_map, sensors_alone, squares_over_time

Array = NDArray[np.float64]

_DEPENDS = 0.02
"""Share of the residual force above which a dependence is reported."""
_STANDS_OUT = 5.0
"""Ratio to the noise in its band above which a residual force is reported, in any record."""


def left_section(found: Trace, result: Outcome, views: Views) -> Section:
    """Return the section: dependence of the residual force, errors over time, single sensors."""
    records = views.records
    signals = records[0].signals
    block = np.concatenate([r.block for r in records])
    values = [np.concatenate([r.signals[j].values for r in records]) for j in range(len(signals))]
    before, after = (
        np.vstack([getattr(r, name) for r in records]) for name in ("force_before", "force_after")
    )
    whole = np.maximum((before**2).mean(axis=0), 1e-300)
    shares_before = _shares(values, before, block)
    shares_after = _shares(values, after, block) * ((after**2).mean(axis=0) / whole)[:, None]
    moved = [j for j, v in enumerate(values) if np.ptp(v) > 0]
    names = [signals[j].name for j in moved]
    parts: list[Part] = [
        Text(
            "The missing force: the generalised force that explains the error, computed by inverse "
            "dynamics with the identified model. Frequencies that noise dominates are removed. "
            + _missing_words(views, before, after, two=bool(result.effects))
        ),
        Picture(
            "trace-dependence",
            to_svg(
                dependence_map(
                    views.dof,
                    names,
                    shares_before[:, moved] if result.effects else None,
                    np.clip(shares_after[:, moved], 0, 1),
                )
            ),
            "Share of the missing force on each DOF that each signal explains.",
            "Dependence of the missing force on single signals. The area and the number (in %) are "
            "the share that a curve over this signal explains, by cross-validation. Correlated "
            "signals explain the same share.",
        ),
    ]
    parts.append(_strongest(views, shares_before, values, before))
    parts += [_time_picture(result, records), *_sensor_parts(found, result, records)]
    return Section("Remaining error", tuple(parts))


def _shares(values: Sequence[Array], force: Array, block: NDArray[np.int64]) -> Array:
    """Return shares (n, m), at least 0, of forces (K, n) that each of m signals explains."""
    return np.array(
        [
            [max(dependence(v, f, block).share, 0.0) if np.ptp(v) > 0 else 0.0 for v in values]
            for f in force.T
        ]
    )


def _missing_words(views: Views, before: Array, after: Array, *, two: bool) -> str:
    parts = []
    for i, (dof, unit) in enumerate(zip(views.dof, views.force_units, strict=True)):
        b, a = (amount(float(np.sqrt(np.mean(f[:, i] ** 2))), unit) for f in (before, after))
        parts.append(f"on {symbol(dof)} {b}" + (f" without and {a} with effects" if two else ""))
    return f"RMS over all records: {'; '.join(parts)}."


def _strongest(views: Views, shares: Array, values: Sequence[Array], force: Array) -> Text:
    """Return a text on the strongest dependence of each DOF's residual force."""
    signals = views.records[0].signals
    block = np.concatenate([r.block for r in views.records])
    out = np.max([r.stands_out_before for r in views.records], axis=0)
    strongest = []
    for i, dof in enumerate(views.dof):
        j = int(np.argmax(shares[i]))
        if shares[i, j] < _DEPENDS or out[i] < _STANDS_OUT:
            continue
        shape = dependence(values[j], force[:, i], block)
        strongest.append(
            f"on {symbol(dof)}, on {signal_text(signals[j].name)} "
            f"({100 * shares[i, j]:.0f} %), {_character(shape)}"
        )
    if not strongest:
        return Text("The missing force does not depend on these signals.")
    return Text(f"Without effects, it depends most {'; '.join(strongest)}.")


def _character(shape: Dependence) -> str:
    """Return a text on whether a dependence is odd, even or neither about the signal's middle."""
    if len(shape.at) < 4:
        return "with too few values for a shape"
    x = shape.at - 0.5 * (shape.at[0] + shape.at[-1])
    x, y = x / np.abs(x).max(), shape.mean
    mirrored = np.interp(-x, x, y)
    odd, even = 0.5 * (y - mirrored), 0.5 * (y + mirrored)
    even = even - even.mean()
    both = float(np.sum(odd**2) + np.sum(even**2))
    if both <= 0:
        return "flat"
    share = float(np.sum(odd**2)) / both
    if share > 0.9:
        return "odd about its middle"
    return "even about its middle" if share < 0.1 else "neither odd nor even"


def _time_picture(result: Outcome, records: Sequence[RecordView]) -> Picture:
    return Picture(
        "trace-time",
        to_svg(
            squares_over_time(
                [r.time_s for r in records],
                [r.before for r in records] if result.effects else None,
                [r.after for r in records],
            )
        ),
        "Mean square of one-step-ahead errors over the session, without and with effects.",
        "Error over the session: mean square of one-step-ahead errors, and of readings beyond the "
        "rigid platform, in blocks of 4 s. Steps between records come from their excitation. A "
        "rise within a record shows that the plant changes.",
    )


def _sensor_parts(found: Trace, result: Outcome, records: Sequence[RecordView]) -> list[Part]:
    if result.beyond is None and not np.isfinite(records[0].sensor_before).any():
        return []
    before, after = (
        np.sqrt(np.mean([getattr(r, name) ** 2 for r in records], axis=0))
        for name in ("sensor_before", "sensor_after")
    )
    sensors, n = found.places.sensor_shape.shape
    return [
        Picture(
            "trace-sensors",
            to_svg(sensors_alone(before if result.effects else None, after)),
            "RMS of each sensor beyond the rigid platform over its noise.",
            f"Single sensors: {sensors} sensors for {n} DOF leave {sensors - n} directions in "
            "which a rigid platform cannot move. A faulty sensor or a flexible platform shows "
            "here, independent of the model.",
        )
    ]
