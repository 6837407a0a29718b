"""Check whether records have a common session time, which drifts and late payloads need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Effect, Placed, Places, Signals
from ....model.effects.operating_range import Extent
from ...records.record import IdentificationError
from ..search_options import SearchOptions
from .record_from_log import TraceRecord

Array = NDArray[np.float64]

_ROWS = SearchOptions.at_a_time
_TS_S = 1.0 / _ROWS
_LATER = 1 / np.pi
"""Time shift of the probe, as a share of the session: it changes any time-dependent effect."""


def overlap(records: Sequence[TraceRecord]) -> str:
    """Return two records that overlap in time, as text; empty if there are none.

    Imported records begin at 0 unless their SIGNALS.yaml says when; so do sessions.
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
    """Return the effects that do not depend on session time, and those that do."""
    now, later = _probes(places, covered)
    kept: list[Effect] = []
    timed: list[Effect] = []
    for effect in effects:
        (timed if _differs(effect, effect.grid[0], now, later) else kept).append(effect)
    return kept, timed


def require_timeless(
    placed: Sequence[Placed], places: Places, covered: Extent, overlapping: str
) -> None:
    """Raise IdentificationError for a declared effect that depends on session time."""
    now, later = _probes(places, covered)
    for p in placed:
        if _differs(p.effect, p.shape, now, later):
            raise IdentificationError(
                f"the model's effect '{p.effect.name}' depends on session time: expected records "
                f"that do not overlap, found {overlapping}; trace one session at a time, or state "
                "begins_s in each SIGNALS.yaml"
            )


def _differs(effect: Effect, shape: Sequence[float], now: Signals, later: Signals) -> bool:
    for one, other in zip(effect.build(now, shape), effect.build(later, shape), strict=True):
        for a, b in zip(one.parts, other.parts, strict=True):
            if a is not None and b is not None and not np.array_equal(a, b):
                return True
    return False


def _probes(places: Places, covered: Extent) -> tuple[Signals, Signals]:
    """Return a random trajectory twice, the second later in the session."""
    rng = np.random.default_rng(0)
    n, begin, end = len(places.dof), *places.span_s

    def random(*columns: int) -> Array:
        return rng.standard_normal((_ROWS, *columns))

    now = Signals(
        Ts_s=_TS_S,
        time_s=np.linspace(begin, end, _ROWS),
        q=random(n) * covered.reach,
        qd=random(n) * covered.speed,
        qdd=random(n),
        coil=covered.command * random(places.coils),
        x_b_m=random(),
        v_b_m_s=random(),
        a_b_m_s2=random(),
        phi_rad=random(),
        phi_rad_s=random(),
        phi_rad_s2=random(),
        delay_cycles=1,
        places=places,
    )
    return now, replace(now, time_s=now.time_s + _LATER * (end - begin))
