"""Summarise a trace of imported records: effects, errors, and what the model still lacks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...value_with_interval import PERCENT, percent
from ..force_balance.reported_errors import PooledError
from ..force_checks.certainty_of_effects import is_told
from ..force_checks.exchanged_columns import Exchange
from ..force_search.rated_candidate import Rated
from .found_law import FoundLaw
from .model_check import (
    ModelCheck,
    beyond_noise,
    check_model,
    missing_only_at_turns,
    taken_by_form,
)
from .model_with_effects import effect_parameters
from .trace_imported import ForceTrace, pooled_errors

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ForceOutcome:
    """The result of a trace of imported records in numbers.

    before, after: errors on the last quarter of each record, which no fit used. metric: what
    measures them; `before_rms` and `after_rms` are in its unit. fitted, free_form (n,): force that
    the model, and a free form of all signals, leave in the fitted rows, in per cent; nan without
    one. For each DOF where it is relevant, as shares of the squared missing force: lacking, what a
    function of the motion predicts; beyond_noise, what the noise of the outputs does not explain;
    form_matters, what a free form of all signals takes beyond that noise. The latter two omit
    at_turns, the DOF with friction where force is missing only while they turn. nearest: the
    rejected candidate that would take most of what is left, as a clause; empty without one.
    exchange: the exchange of columns with which a model without effects explains as much. check:
    the checks of the model with all effects. doubts: why the records can show no effect.
    """

    laws: tuple[FoundLaw, ...]
    metric: str
    before: PooledError
    after: PooledError
    before_rms: float
    after_rms: float
    floor: float | None
    fitted: Array
    free_form: Array
    lacking: Mapping[str, float]
    beyond_noise: Mapping[str, float]
    form_matters: Mapping[str, float]
    at_turns: tuple[str, ...]
    dof: tuple[str, ...]
    nearest: str
    exchange: Exchange | None
    check: ModelCheck
    doubts: tuple[str, ...] = ()

    @property
    def doubtful(self) -> bool:
        """Whether any name is uncertain."""
        return any(law.doubtful for law in self.laws)

    @property
    def doubts_of_all(self) -> tuple[str, ...]:
        """Why the names of all effects are uncertain, as clauses."""
        return self.check.doubts if self.laws else ()

    @property
    def lacks_something(self) -> bool:
        """Whether the model lacks something that may bias its numbers beyond their intervals."""
        inexact = any(law.inexact for law in self.laws)
        more = self.form_matters or self.lacking or self.beyond_noise
        return bool(self.doubtful or inexact or more or self.exchange is not None or self.doubts)

    @property
    def verdict(self) -> str:
        """The result in a sentence."""
        named = [law.name for law in self.laws if not (law.free or law.doubtful)]
        perhaps = [law.name for law in self.laws if law.doubtful]
        forms = [law.placed.effect.name for law in self.laws if law.free and not law.doubtful]
        parts = []
        if named:
            parts.append(f"found: {', '.join(named)}")
        if perhaps:
            parts.append(f"perhaps: {', '.join(perhaps)}")
        if forms:
            parts.append(f"no known law, described by a free form: {', '.join(forms)}")
        if not parts:
            parts.append("no effect is confirmed")
        if self.nearest:
            parts.append(self.nearest)
        return "; ".join([*parts, self.rest])

    @property
    def rest(self) -> str:
        """The missing force that is left, as clauses."""
        left = [
            f"{after:.3g} % of the force at {name}"
            for name, after in zip(self.dof, self.after.force_percent, strict=True)
        ]
        forms = [
            f"in the fitted rows {fitted:.3g} % at {name}, a free form of all signals {form:.3g} %"
            for name, fitted, form in self.with_form
        ]
        return "; ".join([f"the model leaves {', '.join(left)}", *forms, *self.lacks])

    @property
    def with_form(self) -> list[tuple[str, float, float]]:
        """The DOF where a free form takes a relevant part, with the missing force of the model
        and of the form, in per cent of the force in the fitted rows."""
        every = zip(self.dof, self.fitted, self.free_form, strict=True)
        return [one for one in every if one[0] in self.form_matters]

    @property
    def lacks(self) -> list[str]:
        """What no law of the table describes, a clause for each DOF."""
        return [
            f"an unlisted function of the motion would take {percent(share)} of the squared "
            f"missing force at {name}"
            for name, share in self.lacking.items()
        ]


def force_outcome(trace: ForceTrace) -> ForceOutcome:
    """Return the result of a trace in numbers."""
    before, after = pooled_errors(trace)
    free_run = bool(np.all(np.isfinite(after.error)) and np.all(np.isfinite(before.error)))
    if free_run:
        sd = trace.noise_sd
        sizes = [
            float(np.sqrt(np.mean((e / sd) ** 2))) for e in (before.error, after.error, after.floor)
        ]
    else:
        sizes = [float(np.sqrt(np.mean(e.force_percent**2))) for e in (before, after)]
    floor = sizes[2] if free_run and trace.noise_stated else None
    any_law = np.maximum(trace.rows.any_law, trace.options.much_left * trace.rows.noise)
    by_form = taken_by_form(trace, PERCENT * trace.rows.missing, PERCENT * any_law)
    beyond = beyond_noise(trace, after)
    # A candidate that would take noise only is no hint.
    nearest = _nearest(trace) if beyond or by_form else ""
    turning, check = missing_only_at_turns(trace), check_model(trace)
    return ForceOutcome(
        _laws(trace, check),
        "free_run" if free_run else "force",
        before,
        after,
        sizes[0],
        sizes[1],
        floor,
        PERCENT * trace.rows.missing,
        PERCENT * trace.rows.form,
        _lacking(trace),
        {name: share for name, share in beyond.items() if name not in turning},
        {name: share for name, share in by_form.items() if name not in turning},
        turning,
        trace.places.dof,
        nearest,
        trace.exchange,
        check,
        trace.doubts,
    )


def kind(rated: Rated) -> tuple[str, tuple[str, ...]]:
    """Return the class and place of a rated effect."""
    return rated.placed.effect.effect_class, rated.placed.effect.where


def _laws(trace: ForceTrace, check: ModelCheck) -> tuple[FoundLaw, ...]:
    placed = trace.found.point.placed
    parameters, errors = effect_parameters(trace), trace.force_errors
    at = {p.effect.identity: i for i, p in enumerate(placed)}
    laws = []
    for rated, left, leaning in zip(
        trace.found.rated, trace.left_share, trace.leaning, strict=True
    ):
        identity, own = rated.placed.effect.identity, kind(rated)
        # An alternative that was added later is none any more.
        rivals = [r for r in rated.alternatives if r.placed.effect.identity not in at]
        laws.append(
            FoundLaw(
                rated,
                parameters[at[identity]],
                rated.support,
                tuple(r for r in rivals if kind(r) != own),
                tuple(r for r in rivals if kind(r) == own),
                left,
                leaning,
                trace.curves.get(identity),
                is_told(errors[at[identity]], trace.options),
                trace.impossible.get(identity, ()),
                check,
            )
        )
    return tuple(laws)


def _lacking(trace: ForceTrace) -> dict[str, float]:
    """Return, by DOF, the share of the squared missing force that a function of motion predicts.

    DOF are omitted where a free form would take too little to be added: less than `least_free_gain`
    of the squares, or less than `least_force` of the inputs' force.
    """
    return taken_by_form(trace, *trace.unseen)


def _nearest(trace: ForceTrace) -> str:
    options, some = trace.options, bool(trace.found.rated)
    which, rest = ("not added:", " that is left") if some else ("nearest:", "")
    known = {r.placed.effect.identity for r in trace.found.rated}
    for r in trace.found.nearest:
        if r.placed.effect.identity in known:
            continue
        if r.gain.statistic > options.standard_errors and r.share > options.least_free_gain:
            why = "is not confirmed by the fit of the whole model"
            if not r.gain.elsewhere:
                one = len(trace.fitted) == 1
                why = f"is contradicted by {'a half of the' if one else 'a'} record"
            elif r.force <= options.least_force:
                why = "leave the missing force as large as it is"
                if r.force > 0.0:
                    by = percent(r.force, 1)
                    why = f"lower the missing force by {by} of the inputs' force only"
            return (
                f"{which} {r.placed.effect.name}, which would take {r.share:.0%} of the weighed "
                f"squared missing force{rest} and {why}"
            )
    return ""
