"""Reduce columns of a log to envelopes or spectra, block by block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...log.errors import LogError
from ...log.exporting.columns import TIME, Column, chosen_columns, groups_of
from ...log.exporting.export_log import rows_in_range, time_of
from ...log.log_stream import LogStream
from ..plotting.min_max_envelope import Envelope, envelope, over_time

Array = NDArray[np.float64]

BINS = 1400
"""Bins of a figure: about two to a point of its width."""
_FINE_BINS = 8 * BINS
_DEFAULT_GROUPS = ("pose", "beam", "coils", "excitation", "outputs", "reference", "inputs")
_ONE_OF_GROUP = {"beam": ("beam_m",), "coils": ("coil_n",)}
_MOST_DEFAULT = 8
_SEGMENTS, _LONGEST_SEGMENT = 8, 1 << 14


@dataclass(frozen=True)
class Signal:
    """One signal: a column, or one element of an array, with its unit and group of fields."""

    name: str
    field: str
    unit: str
    group: str


@dataclass(frozen=True)
class SignalOverTime:
    """A signal as minimum and maximum over time in s."""

    signal: Signal
    values: Envelope


@dataclass(frozen=True)
class SignalSpectrum:
    """A signal's amplitude spectral density (F,) in unit/sqrt(Hz) at freq_hz (F,)."""

    signal: Signal
    freq_hz: Array
    density: Array


def default_columns(log: LogStream) -> tuple[Column, ...]:
    """Return the columns that are drawn if none is named: pose, beam, coils, excitation.

    For imported logs these are outputs, references and inputs; else the first eight.
    """
    groups = groups_of(log)
    names = [
        field
        for group in _DEFAULT_GROUPS
        for field in groups.get(group, ())
        if field in _ONE_OF_GROUP.get(group, (field,))
    ]
    if not names:
        names = [c.name for c in chosen_columns(log) if c.dtype.kind == "f" and c.name != TIME]
        names = names[:_MOST_DEFAULT]
    return _without_time(chosen_columns(log, names), ())


def named_columns(log: LogStream, names: Sequence[str]) -> tuple[Column, ...]:
    """Return the columns with these names (fields, elements, groups); raises LogError."""
    return _without_time(chosen_columns(log, names), names)


def signals_over_time(
    log: LogStream,
    columns: Sequence[Column],
    begin_s: float | None = None,
    end_s: float | None = None,
) -> tuple[SignalOverTime, ...]:
    """Return the envelopes of columns over a range of the log's time.

    Raises:
        LogError: the range has no rows.
    """
    signals = _signals(log, columns)
    parts: list[list[Envelope]] = [[] for _ in signals]
    fine = _bins_of_block(log, begin_s, end_s)
    for block in rows_in_range(log, begin_s, end_s):
        t = time_of(log, block)
        at = 0
        for column in columns:
            values = np.atleast_2d(np.asarray(column.values(block), np.float64).T)
            for one in values:
                parts[at].append(envelope(t, one, fine))
                at += 1
    return tuple(
        SignalOverTime(signal, over_time(part, BINS))
        for signal, part in zip(signals, parts, strict=True)
    )


def _bins_of_block(log: LogStream, begin_s: float | None, end_s: float | None) -> int:
    """Return the bins of a block, so that those of the whole range are a multiple of BINS."""
    blocks = float(log.chunks)
    if begin_s is not None and end_s is not None and log.stated_rows:
        blocks *= min((end_s - begin_s) * log.rate_hz / log.stated_rows, 1.0)
    return max(int(_FINE_BINS / max(blocks, 1.0)), 4)


def signal_spectra(
    log: LogStream,
    columns: Sequence[Column],
    begin_s: float | None = None,
    end_s: float | None = None,
) -> tuple[SignalSpectrum, ...]:
    """Return amplitude spectral densities by Welch's method (Hann, half overlapped segments).

    The mean of each segment is removed. Missing values are taken as the segment's mean.

    Raises:
        LogError: the range has fewer than 64 rows.
    """
    signals = _signals(log, columns)
    whole = log.stated_rows or _LONGEST_SEGMENT
    if begin_s is not None or end_s is not None:
        whole = sum(len(block.rows) for block in rows_in_range(log, begin_s, end_s))
    length = min(_LONGEST_SEGMENT, 2 * (whole // _SEGMENTS))
    if length < 16:
        raise LogError(f"{log.path}: expected at least 64 rows for a spectrum, found {whole}")
    window = np.hanning(length + 1)[:-1]
    power, count = np.zeros((len(signals), length // 2 + 1)), 0
    waiting = np.zeros((len(signals), 0))
    for block in rows_in_range(log, begin_s, end_s):
        new = [np.atleast_2d(np.asarray(c.values(block), np.float64).T) for c in columns]
        waiting = np.concatenate([waiting, np.concatenate(new)], axis=1)
        while waiting.shape[1] >= length:
            part = waiting[:, :length]
            with np.errstate(invalid="ignore"):
                known = np.isfinite(part)
                mean = np.where(known, part, 0.0).sum(1) / np.maximum(known.sum(1), 1)
            part = np.where(known, part - mean[:, None], 0.0)
            power += np.abs(np.fft.rfft(window * part)) ** 2
            count += 1
            waiting = waiting[:, length // 2 :]
    density = 2.0 * power / (max(count, 1) * log.rate_hz * np.sum(window**2))
    freq_hz = np.asarray(np.fft.rfftfreq(length, 1.0 / log.rate_hz), np.float64)
    return tuple(
        SignalSpectrum(signal, freq_hz[1:], np.asarray(np.sqrt(row[1:]), np.float64))
        for signal, row in zip(signals, density, strict=True)
    )


def without_zero(signals: Sequence[SignalOverTime]) -> tuple[SignalOverTime, ...]:
    """Leave out fields that are zero or missing over the whole range, unless all are."""
    used = {
        s.signal.field
        for s in signals
        if np.any(np.nan_to_num(np.concatenate([s.values.low, s.values.high])))
    }
    return tuple(s for s in signals if s.signal.field in used) or tuple(signals)


def _signals(log: LogStream, columns: Sequence[Column]) -> list[Signal]:
    groups = {field: group for group, fields in groups_of(log).items() for field in fields}
    return [
        Signal(name, column.name, column.unit, groups.get(column.field, ""))
        for column in columns
        for name in column.flat_names
    ]


def _without_time(columns: Sequence[Column], names: Sequence[str]) -> tuple[Column, ...]:
    """Leave out the time, which `chosen_columns` always returns, unless it is named."""
    return tuple(c for k, c in enumerate(columns) if k > 0 or c.name in names)
