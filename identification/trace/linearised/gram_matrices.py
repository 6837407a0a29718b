"""Compute the Gram matrices of a record's errors and columns for each time block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..records.record_from_log import TraceRecord
from ..search_options import SearchOptions

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Beside:
    """The Gram matrices of one candidate's g columns, each divided by `size` (g,).

    cross (blocks, B + 1, g): with the base columns and the errors; inner (blocks, g, g): with each
    other. Products between candidates are not needed.
    """

    cross: Array
    inner: Array
    size: Array


@dataclass(frozen=True)
class Linearised:
    """One record around a working point.

    gram (blocks, B + 1, B + 1): of [scaled parameters, amplitudes and shapes of the effects found,
    errors], each column divided by `size` (B + 1,), which is 1 for the errors. `beside`: one for
    each candidate. count (blocks,): expected squared errors of noise alone.
    """

    name: str
    gram: Array
    size: Array
    count: Array
    time_s: Array
    beside: tuple[Beside, ...] = ()


@dataclass(frozen=True)
class ResidualChannel:
    """Errors (N', i, c) of some columns, by number; the last column is the error itself.

    `own_noise`: the noise is unknown, so the residual itself is the expected error. The first
    `blind` rows (may be fractional) have no errors.
    """

    errors: Array
    columns: list[int]
    own_noise: bool = False
    blind: float = 0.0


def grams(
    record: TraceRecord,
    channels: Sequence[ResidualChannel],
    base: int,
    widths: Sequence[int],
    row_s: float,
) -> Linearised:
    """Return the Gram matrices of a record, summed over channels.

    Columns are [`base` columns, candidates of `widths`, errors]; rows of a channel are `row_s`
    apart. The first channel contains all columns.
    """
    total = base + sum(widths) + 1
    edges = block_edges(len(channels[0].errors), row_s)
    size = _sizes(channels, total)
    own = [*range(base), total - 1]
    gram = np.zeros((len(edges) - 1, base + 1, base + 1))
    cross = np.zeros((len(edges) - 1, base + 1, total))
    starts = base + np.append(0, np.cumsum(widths)).astype(int)
    inner = [np.zeros((len(edges) - 1, width, width)) for width in widths]
    for channel in channels:
        places = np.full(total, -1)
        places[channel.columns] = np.arange(len(channel.columns))
        few = [(i, int(places[j])) for i, j in enumerate(own) if places[j] >= 0]
        rows, at = (list(part) for part in zip(*few, strict=True))
        groups, of_own = _groups_in(places, starts), np.ix_(rows, rows)
        of_all = np.ix_(rows, channel.columns)
        for b, (first, last) in enumerate(pairwise(edges.tolist())):
            part = channel.errors[first:last].reshape(-1, len(channel.columns))
            with_own = part[:, at].T @ part
            gram[b][of_own] += with_own[:, at]
            cross[b][of_all] += with_own
            for g, members, columns in groups:
                some = part[:, columns]
                inner[g][b][members] += some.T @ some
    gram /= size[own] * size[own][:, None]
    cross /= size[own][:, None] * size
    beside = []
    for g, (first, last) in enumerate(pairwise(starts.tolist())):
        own_size = size[first:last]
        scaled = inner[g] / (own_size * own_size[:, None])
        beside.append(Beside(cross[:, :, first:last].copy(), scaled, own_size))
    count = sum((_expected(channel, edges) for channel in channels), np.zeros(len(edges) - 1))
    every = row_s / record.experiment.Ts_s
    middle = np.rint((edges[:-1] + edges[1:]) // 2 * every).astype(int)
    time_s = record.time_s[np.minimum(middle, record.rows - 1)]
    return Linearised(record.name, gram, size[own], count, time_s, tuple(beside))


def block_edges(rows: int, row_s: float) -> NDArray[np.int64]:
    """Return the begin of all blocks and the end of the last; all have at least half a block."""
    block = max(round(SearchOptions.block_s / row_s), 1)
    return np.append(np.arange(0, max(rows - block // 2, 1), block), rows)


def _expected(channel: ResidualChannel, edges: NDArray[np.int64]) -> Array:
    if not channel.own_noise:
        seen = np.maximum(edges - channel.blind, 0.0)
        return np.asarray(np.diff(seen) * float(channel.errors.shape[1]))
    squares = np.sum(channel.errors[:, :, -1] ** 2, axis=1)
    return np.add.reduceat(squares, edges[:-1])


def _sizes(channels: Sequence[ResidualChannel], total: int) -> Array:
    squares = np.zeros(total)
    for channel in channels:
        squares[channel.columns] += np.einsum("nic,nic->c", channel.errors, channel.errors)
    size = np.where(squares > 0, np.sqrt(squares), 1.0)
    size[-1] = 1.0
    return np.asarray(size)


def _groups_in(
    places: NDArray[np.int_], starts: NDArray[np.int_]
) -> list[tuple[int, tuple[Any, ...], slice | list[int]]]:
    """Return the candidates in a channel: number, place in their Gram matrix, and columns."""
    found: list[tuple[int, tuple[Any, ...], slice | list[int]]] = []
    for g, (first, last) in enumerate(pairwise(starts.tolist())):
        there = [(m, int(places[first + m])) for m in range(last - first) if places[first + m] >= 0]
        if not there:
            continue
        members, columns = [m for m, _ in there], [c for _, c in there]
        side_by_side = columns == list(range(columns[0], columns[0] + len(columns)))
        whose = slice(columns[0], columns[-1] + 1) if side_by_side else columns
        found.append((g, np.ix_(members, members), whose))
    return found
