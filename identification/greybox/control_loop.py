"""Hold the control loop of a record, and check an imported record's controller against its data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from ...log.reader import Log
from ...log.signals_yaml import SignalsFile
from ...model.controller import Controller
from ..records.from_log import columns, require_finite
from ..records.record import Record
from .controller_file import controller_of_config

Array = NDArray[np.float64]

_REPRODUCED = 0.01
"""Share of the command's rms below which what a controller leaves counts as rounding."""
_CHANCE = 1e-6
"""Probability by chance below which the rest depends on the outputs."""
_EXPLAINED = 0.005
"""Least share of the rest's variance that outputs and references explain if the controller is
wrong: an excitation with a long memory has a smaller one by itself."""
_LAGS = 20
_TEST_ROWS = 20_000


@dataclass(frozen=True)
class ControlLoop:
    """The control loop: u = feedforward + C(reference, y + seen, v).

    v (N, p): excitation inside the controller's limits, reference (N, r), feedforward (N, p), seen
    (N, n): what the controller measures beyond the outputs. `assumed`: v includes what the
    controller leaves of the recorded command, as an excitation that was not recorded.
    """

    v: Array
    reference: Array
    feedforward: Array
    seen: Array
    controller: Controller
    assumed: bool = False

    def rows(self, cut: slice) -> ControlLoop:
        """Return the rows of a slice."""
        return replace(
            self,
            v=self.v[cut],
            reference=self.reference[cut],
            feedforward=self.feedforward[cut],
            seen=self.seen[cut],
        )


def imported_loop(
    log: Log, signals: SignalsFile, record: Record
) -> tuple[ControlLoop | None, tuple[str, ...]]:
    """Return the loop of an imported record, and remarks; None without a known controller.

    If controller and excitation reproduce the command, the loop is fully known. Otherwise the rest
    of the command counts as an excitation that was not recorded: a simulation then has the input
    u + C(y) - C(y simulated). If outputs or references explain a part of the rest, it is no
    excitation: the controller is wrong, and counts as unknown.
    """
    law = signals.loop and signals.loop.law
    if not law:
        return None, ()
    controller, sources = controller_of_config(
        law, record.input_names, record.output_names, record.Ts_s
    )
    reference = _references(log, sources, len(record.y))
    v = _excitation(log, signals, record)
    start = controller.state_from(reference, record.y, v, record.v)
    rest = record.v - controller.output(reference, record.y, v, start)[0]
    zero = np.zeros_like(record.v)
    loop = ControlLoop(v, reference, zero, np.zeros_like(record.y), controller)
    driven = [record.input_names.index(name) for name in law.drives]
    shares = np.sqrt(np.var(rest, axis=0) / np.maximum(np.var(record.v, axis=0), 1e-300))[driven]
    if np.all(shares <= _REPRODUCED):
        return loop, ()
    if len(driven) == len(record.input_names):
        moving = np.flatnonzero(np.ptp(reference, axis=0))
        signals_of = np.hstack([record.y, reference[:, moving]])
        for i, name in zip(driven, law.drives, strict=True):
            explained, chance = explained_by(rest[:, i], signals_of)
            if chance < _CHANCE and explained > _EXPLAINED:
                return None, (
                    f"loop: controller: it does not fit the record. It leaves "
                    f"{100 * shares.max():.2g} % of {name} (RMS), and outputs and references "
                    f"explain {100 * explained:.2g} % of that; an excitation would not depend on "
                    "them. The controller counts as unknown; check gains, sign, units, rate, and "
                    "whether all references are given",
                )
    return replace(loop, v=v + rest, assumed=True), (
        f"loop: the controller leaves {100 * shares.max():.2g} % of the command (RMS), which "
        "counts as excitation that was not recorded",
    )


def explained_by(rest: Array, signals: Array) -> tuple[float, float]:
    """Return the share of a signal's innovation that other signals explain, and its chance.

    rest (N,), signals (N, s): the rest is predicted from its own last rows, with and without the
    signals' current and last rows. The chance is that of the F test of both sums of squares.
    """
    rest, signals = rest[:_TEST_ROWS], signals[:_TEST_ROWS]
    lags = min(_LAGS, len(rest) // (4 * (signals.shape[1] + 1)))
    rows = len(rest) - lags
    own = [rest[lags - k : len(rest) - k] for k in range(1, lags + 1)]
    others = [signals[lags - k : len(signals) - k] for k in range(lags + 1)]
    X = np.column_stack([np.ones(rows), *own, *others])
    size = np.linalg.norm(X, axis=0)
    stacked = np.column_stack([X / np.where(size > 0.0, size, 1.0), rest[lags:]])
    R: Array = np.asarray(np.linalg.qr(stacked, mode="r"))
    # Squares of the last column of R, from a row on: what the columns before that row leave.
    left = R[:, -1] ** 2
    narrow, wide = 1 + lags, X.shape[1]
    without, with_signals = float(left[narrow:].sum()), float(left[wide:].sum())
    if without <= 0.0:
        return 0.0, 1.0
    freedom = (wide - narrow, rows - wide)
    statistic = (without - with_signals) / freedom[0] / max(with_signals / freedom[1], 1e-300)
    return 1.0 - with_signals / without, float(f_distribution.sf(statistic, *freedom))


def _references(log: Log, sources: Sequence[str | float], rows: int) -> Array:
    names = [name for name in sources if isinstance(name, str)]
    require_finite(log, names)
    found = [columns(log, [s])[:, 0] if isinstance(s, str) else np.full(rows, s) for s in sources]
    return np.column_stack(found) if found else np.zeros((rows, 0))


def _excitation(log: Log, signals: SignalsFile, record: Record) -> Array:
    """Return the recorded excitations (N, p), added up for each input."""
    v = np.zeros_like(record.v)
    for column in signals.with_role("excitation"):
        require_finite(log, [column.name])
        of = column.of or record.input_names[0]
        v[:, record.input_names.index(of)] += columns(log, [column.name])[:, 0]
    return v
