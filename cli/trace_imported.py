"""Describe a trace of imported records for `levid trace` in lines of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from ..identification.value_with_interval import value_with_interval

if TYPE_CHECKING:
    from ..config.model import EffectParameter
    from ..identification.trace.force_trace.found_law import FoundLaw
    from ..identification.trace.force_trace.trace_imported import ForceTrace


def words_of(found: ForceTrace) -> list[str]:
    """Return the results as lines of text; +- is a 95 % interval."""
    from ..identification.trace.force_trace.force_trace_outcome import force_outcome
    from ..identification.trace.force_trace.model_with_effects import (
        declared_effects,
        model_with_effects,
    )
    from ..report.trace.answer import imported_answer

    result = force_outcome(found)
    lines = [imported_answer(result)]
    for i, name in enumerate(result.dof):
        force = f"{result.before.force_percent[i]:.3g} % before"
        force += f", {result.after.force_percent[i]:.3g} % after"
        force += f"; noise of the outputs: {result.after.noise_percent[i]:.2g} %"
        lines.append(f"missing force at {name}, over the force of the inputs: {force}")
        if result.metric == "free_run":
            before, after = result.before.percent[i], result.after.percent[i]
            lines.append(
                f"free-run error of {name}, over the output: {before:.3g} % before, "
                f"{after:.3g} % after"
            )
    lines.append(result.verdict)
    for law in result.laws:
        lines += _law(law)
    if result.doubts_of_all:
        lines.append(f"  every effect is uncertain: {'; '.join(result.doubts_of_all)}")
    for effect, parameters in declared_effects(found):
        lines.append(f"{effect.name}, declared: {_values(parameters)} (95 %)")
    fitted, declared = model_with_effects(found).parameters, found.config.parameters
    values = [
        f"{name} = {value_with_interval(p.value, p.se)} {p.unit}"
        + (
            f" (these records do not determine it; declared {declared[name].value:.4g})"
            if p.se is None
            else ""
        )
        for name, p in fitted.items()
        if name in found.found.point.parameters.names
    ]
    lines.append(f"model: {', '.join(values)}")
    if result.lacks_something:
        lines.append(
            "  the model lacks something: these numbers may be wrong by more than their intervals"
        )
    lines += [
        f"record {e.record}: the simulation with effects did not converge; its error is unreliable"
        for e in found.after
        if not e.settled
    ]
    if result.floor is None:
        lines.append(
            "note: the noise of the outputs is estimated from their highest frequencies; state "
            "noise_sd in the signals file if you know it: more noise at low frequencies looks like "
            "something that the model lacks"
        )
    return lines + [f"note: {note}" for note in found.notes]


def _law(law: FoundLaw) -> list[str]:
    effect, rated = law.placed.effect, law.rated
    values = _values(law.parameters)
    lines = [f"  {law.name}" + ("" if law.free else f": {values} (95 %)"), f"    {effect.equation}"]
    lines.append(
        f"    explains {100 * rated.share:.3g} % of the squared missing force in held-out blocks "
        f"({rated.gain.statistic:.1f} times its standard error)"
    )
    if law.alternatives:
        how = effect.told_apart_by or "another excitation"
        lines.append(
            f"    these records do not distinguish its members; to distinguish them: {how}"
        )
    if law.own_doubts:
        lines.append(f"    uncertain: {'; '.join(law.own_doubts)}")
    if law.inexact:
        lines.append(f"    not exact: {law.inexact}")
    if law.laws:
        names = ", ".join(r.placed.effect.title for r in law.laws)
        lines.append(f"    other laws for it fit as well: {names}")
    return lines


def _values(parameters: Mapping[str, EffectParameter]) -> str:
    return ", ".join(
        f"{name} = {value_with_interval(p.value, p.se)}"
        + ("" if p.unit in ("", "1") else f" {p.unit}")
        for name, p in parameters.items()
    )
