"""Convert the effects entries of a model file to effects with values."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Protocol

from ..declared_model import ModelError
from .actuator_nonlinearity import quadratic_actuator
from .base import Effect, Placed, Places, Quantity, located
from .candidate_effects import all_effects
from .characteristic_after_lag import quadratic_after_lag
from .freeform import freeform_effect
from .magnetic_force import magnetic_force_effect
from .operating_range import Extent
from .permanent_magnet import permanent_magnet_effect
from .power_laws import power_law_effect
from .relative_gains import relative_gains
from .vibration import tone

_TONE = re.compile(r"vibration\.\w+\.([0-9.e+]+)hz")


class DeclaredValue(Protocol):
    """A parameter of an effect in a model file: value, unit, standard error if known."""

    @property
    def value(self) -> float: ...  # noqa: D102
    @property
    def unit(self) -> str: ...  # noqa: D102
    @property
    def se(self) -> float | None: ...  # noqa: D102


class DeclaredEffect(Protocol):
    """An effect in a model file: its name in the table, its location, its parameters by name."""

    @property
    def effect(self) -> str: ...  # noqa: D102
    @property
    def where(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def parameters(self) -> Mapping[str, DeclaredValue]: ...  # noqa: D102


def placed_effects(
    declared: Sequence[DeclaredEffect], places: Places, extent: Extent | None = None
) -> tuple[Placed, ...]:
    """Return the effects of a model file for the locations of a plant, in the file's order.

    `extent` is the range of the records; it sets the bounds for a new fit of shape parameters. The
    bounds always contain the file's values.

    Raises:
        ModelError: an unknown effect or location, a duplicate effect, a missing, unknown or
            wrong-unit parameter; the message names the entry.
    """
    if not declared:
        return ()
    # A file may have a resonance above these records' frequency range, and an effect of a frozen
    # sensor that is not frozen in them.
    covered = replace(
        extent or Extent.typical(places),
        fastest_hz=math.inf,
        stuck=tuple(range(places.sensors)),
    )
    some = [*all_effects(places, covered), *relative_gains(places)]
    table = {e.identity: e for e in some}
    locations = [tuple(located(w, places) for w in entry.where) for entry in declared]
    for entry, at in zip(declared, locations, strict=True):
        found = _TONE.fullmatch(entry.effect)
        if found is not None:
            table |= {e.identity: e for e in tone(places, float(found[1]))}
        for keyed in (
            freeform_effect(places, entry.effect, at),
            magnetic_force_effect(places, covered, entry.effect, at),
            permanent_magnet_effect(places, covered, entry.effect, at),
            power_law_effect(places, entry.effect, at),
            quadratic_actuator(places, entry.effect, at),
            quadratic_after_lag(places, entry.effect, at),
        ):
            if keyed is not None:
                table[keyed.identity] = keyed
    placed: list[Placed] = []
    for i, (entry, at) in enumerate(zip(declared, locations, strict=True)):
        where = f"effects[{i}]"
        new = _placed(entry, at, table, where)
        if any(new.effect.identity == other.effect.identity for other in placed):
            raise ModelError(f"{where}: duplicate effect {new.effect.name}; remove one of them")
        placed.append(new)
    return tuple(placed)


def _placed(
    entry: DeclaredEffect, at: Sequence[str], table: Mapping[str, Effect], where: str
) -> Placed:
    effect = table.get(f"{entry.effect}@{'+'.join(at)}")
    if effect is None:
        raise ModelError(f"{where}: {_unknown(entry, table)}")
    quantities = {q.name: q for q in (*effect.amplitudes, *effect.shape)}
    given = entry.parameters
    if set(given) != set(quantities):
        raise ModelError(
            f"{where}: parameters: expected {', '.join(quantities)} of {entry.effect}, "
            f"found {', '.join(given) or 'none'}"
        )
    for name, quantity in quantities.items():
        if given[name].unit != quantity.unit:
            raise ModelError(
                f"{where}: parameters.{name}: expected the unit '{quantity.unit}', "
                f"found '{given[name].unit}'"
            )
    errors = {name: given[name].se for name in quantities}
    within = tuple(_wide_enough(q, given[q.name].value) for q in effect.shape)
    return Placed(
        replace(effect, shape=within),
        tuple(given[q.name].value for q in effect.shape),
        tuple(given[q.name].value for q in effect.amplitudes),
        {name: error for name, error in errors.items() if error is not None},
    )


def _wide_enough(quantity: Quantity, value: float) -> Quantity:
    return replace(quantity, low=min(quantity.low, value), high=max(quantity.high, value))


def _unknown(entry: DeclaredEffect, table: Mapping[str, Effect]) -> str:
    keys = {e.key for e in table.values()}
    if entry.effect not in keys:
        near = difflib.get_close_matches(entry.effect, keys, 3)
        meant = f"; did you mean {' or '.join(near)}?" if near else ""
        return f"effect: expected a name from the effects table, found '{entry.effect}'{meant}"
    places = ["+".join(e.where) or "[]" for e in table.values() if e.key == entry.effect]
    return (
        f"where: expected one of {', '.join(dict.fromkeys(places))} for {entry.effect}, "
        f"found {'+'.join(entry.where) or '[]'}"
    )
