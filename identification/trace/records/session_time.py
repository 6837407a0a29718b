"""Whether records tell the time of a session, and which effects need it: drifts, a late payload."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Effect, Placed, Places, Signals
from ....model.effects.driven_range import Extent
from ...records.record import IdentificationError
from .trace_record import TraceRecord

Array = NDArray[np.float64]

_ROWS = 256
_TS_S = 1e-3
_LATER = 1 / np.pi
"""Of the session: what depends on its time is another effect by so much later, a tone too."""


def overlap(records: Sequence[TraceRecord]) -> str:
    """Return in words which records claim the same time, nothing where none do.

    Imported records all begin at 0, and so does every session: then nobody knows what came before
    what.
    """
    ordered = sorted(records, key=lambda r: float(r.time_s[0]))
    for before, after in pairwise(ordered):
        if after.time_s[0] < before.time_s[-1]:
            spans = [f"{r.name} {r.time_s[0]:.4g} to {r.time_s[-1]:.4g} s" for r in (before, after)]
            return " and ".join(spans)
    return ""


def timeless(
    effects: Sequence[Effect], places: Places, covered: Extent
) -> tuple[list[Effect], list[Effect]]:
    """Return the effects that do not depend on the session's time, and those that do."""
    now, later = _probes(places, covered)
    kept: list[Effect] = []
    timed: list[Effect] = []
    for effect in effects:
        (timed if _differs(effect, effect.grid[0], now, later) else kept).append(effect)
    return kept, timed


def require_timeless(
    placed: Sequence[Placed], places: Places, covered: Extent, overlapping: str
) -> None:
    """Raise IdentificationError for a declared effect that depends on the session's time."""
    now, later = _probes(places, covered)
    for p in placed:
        if _differs(p.effect, p.shape, now, later):
            raise IdentificationError(
                f"expected records one after the other in time, since the model's effect "
                f"'{p.effect.name}' depends on it, found {overlapping}, which overlap"
            )


def _differs(effect: Effect, shape: Sequence[float], now: Signals, later: Signals) -> bool:
    for one, other in zip(effect.build(now, shape), effect.build(later, shape), strict=True):
        for a, b in zip(one.parts, other.parts, strict=True):
            if a is not None and b is not None and not np.array_equal(a, b):
                return True
    return False


def _probes(places: Places, covered: Extent) -> tuple[Signals, Signals]:
    """Return the same lively trajectory twice, the second later in the session."""
    rng = np.random.default_rng(0)
    n, begin, end = len(places.dof), *places.span_s

    def lively(*columns: int) -> Array:
        return rng.standard_normal((_ROWS, *columns))

    now = Signals(
        Ts_s=_TS_S,
        time_s=np.linspace(begin, end, _ROWS),
        q=lively(n) * covered.reach,
        qd=lively(n) * covered.speed,
        qdd=lively(n),
        coil=covered.command * lively(places.coils),
        x_b_m=lively(),
        v_b_m_s=lively(),
        a_b_m_s2=lively(),
        phi_rad=lively(),
        phi_rad_s=lively(),
        phi_rad_s2=lively(),
        delay_cycles=1,
        places=places,
    )
    return now, replace(now, time_s=now.time_s + _LATER * (end - begin))
