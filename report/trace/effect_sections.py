"""Build a report section for each effect: equation, parameters, measured and fitted shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ...config.model import EffectParameter
from ...identification.subspace.response_uncertainty import SURE_95
from ...identification.trace.figure_data import Aspect, RecordView, Views
from ...identification.trace.residual.binned_means import dependence
from ...identification.trace.trace_outcome import FoundEffect, Outcome, RandomForce, telling
from ..plotting.figure_to_svg import Picture, to_svg
from ..plotting.html_page import Part, Section, Table, Text
from ..plotting.number_format import (
    amount,
    half_percent,
    place_text,
    share_text,
    signal_text,
    with_interval,
)
from ..session.session_page import listed
from .effect_shapes import Shape, effect_shapes

Array = NDArray[np.float64]

_ENOUGH = 0.6
"""Share of an effect that one signal must explain; below, it is drawn over its fitted value."""
_RATHER = 0.1
_OF_CHANNEL = ("command of", "height at", "speed at")
_STRETCH_S = 4.0
_MOST_SHAPES = 3


def effect_sections(result: Outcome, views: Views) -> list[Section]:
    """Return a section for each found effect, random force and declared effect."""
    sections: list[Section] = []
    for found in result.effects:
        number = len(sections) + 1
        sections.append(Section(f"{number}. {found.name}", tuple(_parts(found, views, number))))
    for force in result.shaken:
        sections.append(Section(f"{len(sections) + 1}. {force.name}", _random_parts(force)))
    for found in result.declared:
        number = len(sections) + 1
        sections.append(Section(f"{number}. {found.name}", tuple(_parts(found, views, number))))
    return sections


def _random_parts(force: RandomForce) -> tuple[Part, ...]:
    s = force.shaking
    rms = EffectParameter(value=s.rms, se=s.se, unit=force.unit)
    rows = [("rms", with_interval(rms), half_percent(s.rms, s.se))]
    rows += [
        (name, f"{at:.3g} Hz", "—") for name, at in zip(("low", "high"), s.band_hz, strict=True)
    ]
    return (
        Text(f"{force.equation}.", "lead"),
        Text(
            "A random force cannot be predicted, so model.yaml does not contain it. Its power in "
            f"held-out records exceeds that of noise (by {s.statistic:.0f} standard errors)."
        ),
        Table(
            "Parameters with 95 % intervals",
            ("parameter", "value", "half the interval"),
            tuple(rows),
        ),
    )


def sizes(found: FoundEffect, views: Views) -> tuple[str, str, float, float] | None:
    """Return location, unit, largest record RMS and maximum of an effect's largest part."""
    parts = _aspects(found, views)
    if not parts:
        return None
    part = parts[0]
    rms = max(float(np.sqrt(np.mean(a.fitted**2))) for _, a in part.records)
    most = max(float(np.max(np.abs(a.fitted))) for _, a in part.records)
    return _on(place_text(part.place, views.dof)), part.unit, rms, most


def effect_figure(found: FoundEffect, views: Views) -> Figure | None:
    """Draw an effect, measured and fitted; None if no record shows it."""
    shapes = [_shape(part, views.dof) for part in _aspects(found, views)]
    return effect_shapes(shapes) if shapes else None


@dataclass(frozen=True)
class _Everywhere:
    """A part of an effect in all records."""

    place: str
    unit: str
    records: tuple[tuple[RecordView, Aspect], ...]

    @property
    def fitted(self) -> Array:
        return np.concatenate([a.fitted for _, a in self.records])

    @property
    def measured(self) -> Array:
        return np.concatenate([a.measured for _, a in self.records])

    @property
    def block(self) -> NDArray[np.int64]:
        return np.concatenate([a.block for _, a in self.records])

    def signal(self, number: int) -> Array:
        return np.concatenate([a.signals[number].values for _, a in self.records])


def _aspects(found: FoundEffect, views: Views) -> list[_Everywhere]:
    """Return the parts of an effect, the clearest first."""
    by_place: dict[str, list[tuple[RecordView, Aspect]]] = {}
    for record in views.records:
        for aspect in record.aspects:
            if aspect.identity == found.effect.identity and np.any(aspect.fitted):
                by_place.setdefault(aspect.place, []).append((record, aspect))
    parts = [
        _Everywhere(place, records[0][1].unit, tuple(records))
        for place, records in by_place.items()
    ]
    return sorted(parts, key=lambda p: -_clarity(p))[:_MOST_SHAPES]


def _clarity(part: _Everywhere) -> float:
    left = part.measured - part.fitted
    return float(np.sum(part.fitted**2) / max(float(np.sum(left**2)), 1e-300)) * len(part.fitted)


def _parts(found: FoundEffect, views: Views, number: int) -> list[Part]:
    effect, why = found.effect, found.evidence
    parts: list[Part] = [Text(f"{effect.equation}.", "lead")]
    if why is not None:
        confirmed = "Held-out records confirm it"
        if not why.held:
            confirmed = (
                "It is small in the held-out records; blocks of the other records confirm it"
            )
        parts.append(
            Text(
                f"Added in round {why.round}. Four-fold cross-validation: the squared error falls "
                f"by {why.explained:,.0f} noise variances"
                + ("" if why.share is None else f", {share_text(why.share)}")
                + f". {confirmed} (by {why.statistic:.0f} standard errors)."
            )
        )
    parts.append(_parameter_table(found))
    shapes = [_shape(part, views.dof) for part in _aspects(found, views)]
    if shapes:
        parts.append(
            Picture(
                f"effect-{number}",
                to_svg(effect_shapes(shapes)),
                f"{effect.name}: measured against fitted, over what it depends on and over time.",
                f"{effect.name} as measured and as fitted. Measured: the error of the model with "
                "all other effects but without this one. One filter for all curves removes "
                "frequencies that noise dominates. The mean over a record is as fitted, because "
                "the record's constant force hides it. Intervals are from the spread between "
                "blocks of 4 s. "
                f"{_difference_words(shapes)}",
            )
        )
    parts += [Text(text) for text in _neighbours(found)]
    return parts


def _parameter_table(found: FoundEffect) -> Table:
    rows = [
        (name, with_interval(p), half_percent(p.value, p.se))
        for name, p in found.parameters().items()
    ]
    return Table(
        "Parameters with 95 % intervals",
        ("parameter", "value", "half the interval"),
        tuple(rows),
    )


def _neighbours(found: FoundEffect) -> list[str]:
    effect, why = found.effect, found.evidence
    texts = []
    if why is not None and why.alternatives:
        names = listed([e.name for e in why.alternatives])
        how = f" To tell them apart, record: {telling(found)}." if telling(found) else ""
        first = f"{effect.name} is shown as an example. " if found.others else ""
        texts.append(
            f"{first}These records cannot tell it from {names}, which fit equally well.{how}"
        )
    elif why is not None:
        texts.append("No other fitted effect explains these records equally well.")
    if effect.absorbed_by:
        texts.append(f"No record can tell it from this part of the model: {effect.absorbed_by}.")
    return texts


def _shape(part: _Everywhere, dof: Sequence[str]) -> Shape:
    """Return a part of an effect over the signal that explains most of it."""
    fitted, measured, block = part.fitted, part.measured, part.block
    signals = part.records[0][1].signals
    shares = [
        dependence(part.signal(j), fitted, block).share if np.ptp(part.signal(j)) > 0 else 0.0
        for j in range(len(signals))
    ]
    # Prefer a channel's own command or height to signals that are correlated with it.
    own = [s.name.startswith(_OF_CHANNEL) for s in signals]
    best = int(np.argmax(np.array(shares) + _RATHER * np.array(own)))
    if shares[best] >= _ENOUGH:
        over, name, unit = part.signal(best), signals[best].name, signals[best].unit
    else:
        over, name, unit = fitted, "the fitted effect", part.unit
    by_measured, by_fitted = (dependence(over, y, block) for y in (measured, fitted))
    record, stretch = _liveliest(part.records)
    aspect = next(a for r, a in part.records if r is record)
    time_s = next(s.values for s in aspect.signals if s.name == "time")[stretch]
    return Shape(
        place_text(part.place, dof), part.unit, name, unit,
        by_measured.at, by_measured.mean, by_measured.error, by_fitted.mean,
        record.name, time_s, aspect.measured[stretch], aspect.fitted[stretch],
    )  # fmt: skip


def _liveliest(records: Sequence[tuple[RecordView, Aspect]]) -> tuple[RecordView, slice]:
    """Return the record and the time span in it where the effect is largest."""
    best: tuple[float, RecordView, slice] | None = None
    for record, aspect in records:
        time_s = next(s.values for s in aspect.signals if s.name == "time")
        rows = max(int(np.searchsorted(time_s, time_s[0] + _STRETCH_S)), 2)
        power = np.convolve(aspect.fitted**2, np.ones(rows), "valid")
        if not power.size:
            continue
        at = int(np.argmax(power))
        if best is None or power[at] > best[0]:
            best = float(power[at]), record, slice(at, at + rows)
    if best is None:
        return records[0][0], slice(None)
    return best[1], best[2]


def _difference_words(shapes: Sequence[Shape]) -> str:
    """Return a sentence about the difference of measured and fitted shape."""
    shape = shapes[0]
    apart = np.abs(shape.measured - shape.fitted)
    inside = float(np.mean(apart <= SURE_95 * shape.error)) if len(apart) else 1.0
    over = signal_text(shape.over)
    return (
        f"Over {over}, {100 * inside:.0f} % of the intervals contain the fitted effect; "
        f"the largest difference is {amount(float(apart.max(initial=0.0)), shape.unit)}."
    )


def _on(place: str) -> str:
    """Return a location as it follows a number, such as 'on z' or 'at coil 3'."""
    for head, instead in (
        ("force of the beam", "on the beam"),
        ("force of ", "at "),
        ("force ", ""),
        ("reading of ", "at "),
        ("readings, ", "in the readings, "),
    ):
        if place.startswith(head):
            return instead + place.removeprefix(head)
    return place
