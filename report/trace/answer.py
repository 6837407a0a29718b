"""State the result of a trace in sentences that anyone at the rig understands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...identification.trace.search_options import SearchOptions
from ...identification.trace.trace_outcome import NOISE_MOST
from ...identification.value_with_interval import PERCENT, percent
from ..plotting.labelled_frequency_responses import symbol
from ..plotting.number_format import times_text
from ..session.session_page import listed
from .effect_in_words import effect_in_words

if TYPE_CHECKING:
    from ...identification.trace.force_trace.force_trace_outcome import ForceOutcome
    from ...identification.trace.trace_outcome import Outcome


@dataclass(frozen=True)
class Clause:
    """One effect in words; `others` are effects that the records do not tell from it.

    doubtful: whether another effect may be the cause. free: a free form, no known effect.
    """

    text: str
    others: tuple[str, ...] = ()
    doubtful: bool = False
    free: bool = False


def rig_answer(result: Outcome) -> str:
    """Return the answer of a trace of a rig's logs."""
    clauses = [
        Clause(
            effect_in_words(f.effect, f.parameters()),
            tuple(e.name for e in f.others),
            result.in_doubt(f) or bool(result.perhaps_part_of(f)),
            f.unknown,
        )
        for f in result.effects
    ]
    return answer(clauses, _rest_of_rig(result))


def imported_answer(result: ForceOutcome) -> str:
    """Return the answer of a trace of imported records.

    Effects that were found with exchanged columns are no answer: they only stand for the exchange.
    """
    if result.doubts:
        return f"These records show no effect that can be trusted: {'; '.join(result.doubts)}."
    if result.exchange is not None:
        uncertain = (
            [] if not result.laws else ["the effects found with the present columns mislead"]
        )
        return " ".join(_sentence(clause) for clause in (result.exchange.sentence, *uncertain))
    clauses = [
        Clause(
            law.name if law.free else effect_in_words(law.placed.effect, law.parameters),
            tuple(r.placed.effect.name for r in law.alternatives),
            law.doubtful,
            law.free,
        )
        for law in result.laws
    ]
    return answer(clauses, _rest_of_imported(result))


def answer(clauses: Sequence[Clause], rest: str) -> str:
    """Return the answer: effects without doubt, ambiguous and doubtful ones, and what is left.

    rest: a sentence on the remaining error.
    """
    sentences = []
    named = [c.text for c in clauses if not (c.others or c.doubtful or c.free)]
    if named:
        sentences.append(_sentence(listed(list(dict.fromkeys(named)))))
    for clause in clauses:
        if clause.others:
            first = "perhaps" if clause.doubtful else "either"
            other = f"{first} {clause.text}, or the cause is: {', or '.join(clause.others)}"
            sentences.append(_sentence(f"{other}; these records cannot tell which"))
        elif clause.free:
            unknown = "an unknown effect remains, described by a free form"
            first = "perhaps " if clause.doubtful else ""
            sentences.append(_sentence(f"{first}{unknown}: {clause.text}"))
        elif clause.doubtful:
            sentences.append(_sentence(f"perhaps {clause.text}"))
    return " ".join([*sentences, rest])


def _sentence(clause: str) -> str:
    return f"{clause[0].upper()}{clause[1:]}."


def _rest_of_rig(result: Outcome) -> str:
    """Return a sentence on what the model and its effects leave."""
    ratio = f"{times_text(result.after / result.floor)} times the noise"
    parts = [
        f"A random force shakes the platform: {force.name}. It cannot be predicted."
        for force in result.shaken
    ]
    if result.overrated:
        parts.append(
            "There is no conclusion on the remaining error: the noise was overestimated, because "
            "the readings contain more than noise at their highest frequencies. Sample faster, or "
            "excite less there."
        )
    elif not result.noise_measured:
        parts.append(
            "There is no conclusion on the remaining error: no record without excitation measures "
            "the noise."
        )
    elif not result.significant:
        parts.append(
            "Nothing else is left: the remaining error is noise."
            if result.effects or result.shaken
            else "The declared model explains these records down to the noise. No undeclared "
            "effect was found."
        )
    elif result.after <= NOISE_MOST * result.floor:
        parts.append(
            "A small error is left, which shows one step ahead only. No known effect explains it."
        )
    else:
        worst = max(result.dof, key=lambda d: d.after / d.floor)
        also = "" if result.shaken else " No known effect explains the rest."
        parts.append(
            f"An error of {ratio} is left, most in {symbol(worst.name)} from "
            f"{worst.band_hz[0]:.2g} to {worst.band_hz[1]:.2g} Hz.{also}"
        )
    return " ".join(parts)


def _described(result: ForceOutcome) -> list[str]:
    """Return a clause on what a free form describes and no law does, if it matters."""
    if result.lacks or not result.form_matters:
        return []
    several = len(result.dof) > 1
    left = listed(
        [
            f"{fitted:.3g} %" + (f" at {symbol(name)}" if several else "")
            for name, fitted, _ in result.with_form
        ]
    )
    form = listed([f"{form:.3g} %" for _, _, form in result.with_form])
    what = "something else" if result.laws else "something"
    return [
        f"the model lacks {what}: in the fitted rows it leaves {left} of the force, with a free "
        f"form of all signals {form}"
    ]


def _beyond_noise(result: ForceOutcome) -> list[str]:
    """Return a clause on what is more than noise, where neither a form nor a law describes it."""
    if result.lacks or result.form_matters or not result.beyond_noise:
        return []
    noise = [
        f"{percent:.2g} %" + (f" at {symbol(name)}" if len(result.dof) > 1 else "")
        for name, percent in zip(result.dof, result.after.noise_percent, strict=True)
        if name in result.beyond_noise
    ]
    what = "something else" if result.laws else "something"
    return [f"the model lacks {what}: the noise of the outputs explains {' and '.join(noise)} only"]


def _at_turns(result: ForceOutcome) -> list[str]:
    """Return a clause on DOF of which all that is left is where they turn."""
    if not result.at_turns:
        return []
    names = listed([symbol(name) for name in result.at_turns])
    return [
        f"what is left at {names} is left at the turns, where friction may hold it for a moment"
    ]


def _by_noise(result: ForceOutcome) -> str:
    """Return a clause on noise of the outputs that may be what the model seems to lack."""
    return (
        "it may be noise of the outputs that is larger at low frequencies than at high ones: "
        "fitted to the outputs themselves, the model without effects is within "
        f"{result.check.outputs:.2g} % of them; state noise_sd in the signals file"
    )


def _rest_of_imported(result: ForceOutcome) -> str:
    """Return a sentence on the missing force, before and after."""
    less, more, same = list[str](), list[str](), list[str]()
    several = len(result.dof) > 1
    for i, name in enumerate(result.dof):
        before, after = (float(e.force_percent[i]) for e in (result.before, result.after))
        at = f" at {symbol(name)}" if several else ""
        if math.isclose(before, after, rel_tol=SearchOptions.accuracy):
            same.append(f"{after:.3g} %{at}")
        else:
            changed = more if after > before else less
            changed.append(f"from {before:.3g} to {after:.3g} %{at}")
    clauses = (*result.lacks, *_described(result), *_beyond_noise(result), *_at_turns(result))
    # A function of the signals that takes nearly all of it is no noise.
    taken = max(result.form_matters.values(), default=0.0)
    no_noise = taken > 1.0 - SearchOptions().least_free_gain
    if np.isfinite(result.check.outputs) and (clauses or result.laws) and not no_noise:
        clauses = (*clauses, _by_noise(result))
    lacks = "".join(f" {_sentence(clause)}" for clause in clauses)
    if result.laws:
        whole = [np.linalg.norm(e.force_percent) for e in (result.before, result.after)]
        verbs = [("falls", less), ("rises", more), ("stays", same)]
        if whole[1] >= whole[0]:
            verbs = [("does not fall:", less + more), ("stays", same)]
        changes = " and ".join(f"{verb} {', '.join(some)}" for verb, some in verbs if some)
        once = changes.replace(" %", " % of the inputs' force", 1)
        return f"The missing force {once}.{lacks}"
    left = "; ".join(
        f"{e:.3g} % of the inputs' force" + (f" at {symbol(name)}" if several else "")
        for e, name in zip(result.after.force_percent, result.dof, strict=True)
    )
    least = SearchOptions().least_force
    noise = SearchOptions().much_left * result.after.noise_percent + PERCENT * least
    if clauses or not np.all(result.after.force_percent <= noise):
        return f"No undeclared effect was confirmed. The model leaves {left} unexplained.{lacks}"
    return (
        f"No undeclared effect was confirmed. The model leaves {left}: no more than noise and the "
        f"{percent(least, 1)} of that force to which an equation is trusted."
    )
