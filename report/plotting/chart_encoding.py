"""Encode charts compactly for the page: 16 bits a value, differences, deflated, in base64.

The text is deflated: a little-endian uint32 with the length of the JSON, the JSON, the arrays in
the order in which the JSON names them. Times of equal steps are two numbers, other abscissae are
float64. A value is a multiple of a step (1/65000 of the range in its bins, in decades on a
logarithmic axis); values are stored as differences, high bytes first. interactive/chart_data.js
decodes the text.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np
from numpy.typing import NDArray

from .chart import Axis, Chart, Entry, Look, Mark, Note, Panel, Rectangle, Segments, Series
from .min_max_bins import Bins

Array = NDArray[np.float64]
JsonValue = dict[str, object]

_LEVELS = 65_000
_MISSING = 65_535
_TEXT_BYTES_PER_VALUE = 2.2
"""Typical length of the text for one value of a noisy signal."""
_SAME_STEP = 0.01
_LEAST_BINS = 1000
"""Bins of a signal below which it is not made coarser, as the static picture has as many."""


def encode_charts(charts: Sequence[Chart], most_bytes: float = np.inf) -> list[str]:
    """Return the text of each chart, of `most_bytes` in all if bins can be made that coarse.

    All signals get bins of equally many samples, a power of two, but none fewer than 1000 bins.
    """
    count, coarsest = 1, _coarsest(charts)
    while _values(charts, count) * _TEXT_BYTES_PER_VALUE > 2 * most_bytes and count < coarsest:
        count *= 2
    while True:
        texts = [encode(_coarser(chart, count)) for chart in charts]
        if sum(map(len, texts)) <= most_bytes or count >= coarsest:
            return texts
        count *= 2


def _coarsest(charts: Sequence[Chart]) -> int:
    """Return the largest number of samples in a bin that is worth trying."""
    signals = [s.samples for c in charts for p in c.panels for s in p.series]
    longest = max((sum(len(r.t) * r.count for r in runs) for runs in signals), default=0)
    return 1 << max(0, (longest // _LEAST_BINS).bit_length() - 1)


def encode(chart: Chart) -> str:
    """Return the text of a chart."""
    encoder = _Encoder()
    described = encoder.chart(chart)
    head = json.dumps(described, ensure_ascii=False, separators=(",", ":")).encode()
    raw = len(head).to_bytes(4, "little") + head + b"".join(encoder.arrays)
    return base64.b64encode(zlib.compress(raw, 9)).decode("ascii")


def _coarser(chart: Chart, count: int) -> Chart:
    """Return a chart whose bins hold at least `count` samples, except for those to be kept."""
    panels = (
        replace(panel, series=tuple(_with_bins(series, count) for series in panel.series))
        for panel in chart.panels
    )
    return replace(chart, panels=tuple(panels))


def _with_bins(series: Series, count: int) -> Series:
    total = sum(len(run.t) * run.count for run in series.samples)
    while count > 1 and total < _LEAST_BINS * count:  # a shorter signal than others
        count //= 2
    runs = tuple(run if run.kept else run.coarser(count // run.count) for run in series.samples)
    return replace(series, samples=runs)


def _values(charts: Sequence[Chart], count: int) -> int:
    """Return the number of values that the charts store with bins of `count` samples."""
    total = 0
    for run in (r for c in charts for p in c.panels for s in p.series for r in s.samples):
        factor = 1 if run.kept else max(count // run.count, 1)
        bins = -(-len(run.t) // factor)
        total += bins if factor * run.count == 1 else 2 * bins
    return total


class _Encoder:
    """Collects the arrays of a chart while it describes the chart."""

    def __init__(self) -> None:
        self.arrays: list[bytes] = []
        self._abscissae: dict[bytes, int] = {}

    def chart(self, chart: Chart) -> JsonValue:
        """Describe a chart."""
        return {
            "columns": chart.columns,
            "entries": [_entry(entry) for entry in chart.entries],
            "legend": chart.legend,
            "panels": [self._panel(panel) for panel in chart.panels],
        }

    def _panel(self, panel: Panel) -> JsonValue:
        return {
            "row": panel.row,
            "column": panel.column,
            "height": round(panel.height),
            "title": panel.title,
            "right": panel.right_title,
            "legend": panel.legend,
            "x": _axis(panel.x),
            "y": _axis(panel.y),
            "series": [self._series(s, panel.y.log) for s in panel.series],
            "marks": [_mark(mark) for mark in panel.marks],
        }

    def _series(self, series: Series, log: bool) -> JsonValue:
        return {
            "kind": series.kind,
            "label": series.label,
            "entry": series.entry,
            "look": _look(series.look),
            "runs": [self._run(run, log) for run in series.samples],
        }

    def _run(self, run: Bins, log: bool) -> JsonValue:
        # The arrays' order is the order in which chart_data.js reads them: x, low, high.
        described: JsonValue = {"n": len(run.t), "count": run.count, "x": self._abscissa(run)}
        low, high = (_on_scale(v, log) for v in (run.low, run.high))
        two = not np.array_equal(low, high, equal_nan=True)
        finite = np.concatenate([v[np.isfinite(v)] for v in (low, high)])
        bottom = float(finite.min()) if finite.size else 0.0
        step = (float(finite.max()) - bottom) / _LEVELS if finite.size else 0.0
        for values in (low, high) if two else (low,):
            self._add(values, bottom, step)
        return described | {"low": bottom, "step": step, "two": two}

    def _add(self, values: Array, bottom: float, step: float) -> None:
        whole = np.full(len(values), _MISSING)
        known = np.isfinite(values)
        whole[known] = np.rint((values[known] - bottom) / step) if step > 0 else 0
        changes = np.diff(whole, prepend=0) % 65_536
        self.arrays += [
            (changes >> 8).astype(np.uint8).tobytes(),
            changes.astype(np.uint8).tobytes(),
        ]

    def _abscissa(self, run: Bins) -> object:
        """Return [begin, step] of equal steps, or the number of an array that was added."""
        t = run.t
        step = float(t[-1] - t[0]) / (len(t) - 1) if len(t) > 1 else 1.0
        even = t[0] + step * np.arange(len(t))
        if np.all(np.abs(t - even) <= _SAME_STEP * abs(step)):
            return [float(t[0]), step]
        raw = np.ascontiguousarray(t, "<f8").tobytes()
        if raw not in self._abscissae:
            self._abscissae[raw] = len(self._abscissae)
            self.arrays.append(raw)
        return self._abscissae[raw]


def _on_scale(values: Array, log: bool) -> Array:
    if not log:
        return np.where(np.isfinite(values), values, np.nan)
    positive = np.isfinite(values) & (values > 0)
    return np.log10(np.where(positive, values, 1.0)) + np.where(positive, 0.0, np.nan)


def _entry(entry: Entry) -> JsonValue:
    return {"label": entry.label, "look": _look(entry.look), "area": entry.area}


def _look(look: Look) -> JsonValue:
    plain = asdict(look)
    plain["width"], plain["size"] = round(look.width, 2), round(look.size, 2)
    plain["dash"] = [round(d, 1) for d in look.dash]
    return plain


def _axis(axis: Axis) -> JsonValue:
    return asdict(axis)


def _mark(mark: Mark) -> JsonValue:
    kind = {Rectangle: "rectangle", Segments: "segments", Note: "note"}[type(mark)]
    plain = asdict(mark)
    if "look" in plain:
        plain["look"] = _look(mark.look)  # type: ignore[union-attr]
    return {"mark": kind, **plain}
