"""Gram matrices of a record's errors and columns, block of time by block of time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..records.trace_record import TraceRecord

Array = NDArray[np.float64]

BLOCK_S = 4.0
"""Errors of one block stand and fall together: longer than what a platform remembers."""


@dataclass(frozen=True)
class Beside:
    """The g columns of one candidate, each over `size` (g,): what a question about it takes.

    cross (blocks, B + 1, g) with the columns that every candidate stands beside, and the errors;
    inner (blocks, g, g) with one another. What candidates have with each other nobody asks.
    """

    cross: Array
    inner: Array
    size: Array


@dataclass(frozen=True)
class Linearised:
    """One record around a working point.

    gram (blocks, B + 1, B + 1): of [model's parameters over scale, amplitudes and shapes of the
    effects found, errors], each column over `size` (B + 1,), that of the errors 1. `beside`: one
    for every candidate. count (blocks,): squared errors that noise alone makes, one each.
    """

    name: str
    gram: Array
    size: Array
    count: Array
    time_s: Array
    beside: tuple[Beside, ...] = ()


@dataclass(frozen=True)
class ResidualChannel:
    """Errors (N', i, c) of some of the columns, by number; the last column is the error itself.

    Where what is left has to stand for a noise that nobody knows (`own_noise`), it is all expected.
    In the first `blind` of its rows, which need not be a whole number, there are no errors.
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

    Columns are [`base` of them, candidates of `widths`, errors]; rows of a channel are `row_s`
    apart. The first channel has them all.
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
        groups = _groups_in(places, starts)
        for b, (first, last) in enumerate(pairwise(edges.tolist())):
            part = channel.errors[first:last].reshape(-1, len(channel.columns))
            with_own = part[:, at].T @ part
            gram[b][np.ix_(rows, rows)] += with_own[:, at]
            cross[b][np.ix_(rows, channel.columns)] += with_own
            for g, members, columns in groups:
                some = part[:, columns]
                inner[g][b][np.ix_(members, members)] += some.T @ some
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
    """Return where blocks begin, and the end of the last: none is shorter than half a block."""
    block = max(round(BLOCK_S / row_s), 1)
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
) -> list[tuple[int, list[int], slice | list[int]]]:
    """Return the candidates that a channel shows: number, members, and their columns in it."""
    found: list[tuple[int, list[int], slice | list[int]]] = []
    for g, (first, last) in enumerate(pairwise(starts.tolist())):
        there = [(m, int(places[first + m])) for m in range(last - first) if places[first + m] >= 0]
        if not there:
            continue
        members, columns = [m for m, _ in there], [c for _, c in there]
        side_by_side = columns == list(range(columns[0], columns[0] + len(columns)))
        found.append((g, members, slice(columns[0], columns[-1] + 1) if side_by_side else columns))
    return found
