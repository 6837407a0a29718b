"""Summarise a trace of imported records: effects and errors as JSON, in words, as a model file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....config.model import EffectParameter, ModelConfig, ModelEffect
from ....model.effects.base import Effect
from ....model.effects.freeform import depends_on
from ...json_data import plain_json
from ...value_with_interval import PERCENT, percent
from ..parameter_covariance import parameter_covariance
from .certainty_of_effects import is_told
from .exchanged_columns import Exchange
from .found_law import FoundLaw
from .free_numbers import at_limits, by_value, numbers_of
from .output_error_fit import as_close
from .rated_candidate import Rated
from .reported_errors import PooledError
from .trace_imported import ForceTrace, pooled_errors

Array = NDArray[np.float64]

ABOUT = {
    "free_run": (
        "RMS of the free-run simulation error over rows and outputs, in standard deviations of the "
        "output noise, on the last quarter of every record; its first third (at most 5 s) does not "
        "count"
    ),
    "force": (
        "RMS of the force that the model lacks over the force of the inputs, in per cent, below "
        "{limit:.3g} Hz, on the last quarter of every record"
    ),
}
_MOST_ERROR_SHARE = 0.5
"""Largest standard error of an identified parameter, over its uncertainty before."""


@dataclass(frozen=True)
class ForceOutcome:
    """The result of a trace of imported records in numbers.

    before, after: errors on the reported rows. metric: what measures them; `before_rms`,
    `after_rms` in its unit. fitted, free_form (n,): what the model and a free form of all signals
    leave of the force in the fitted rows, in per cent, nan without one. lacking: by DOF, the share
    of the squared missing force that a function of the motion foretells, where it matters.
    beyond_noise: by DOF, the share of the squared missing force that the noise of the outputs does
    not explain, where it matters. form_matters: by DOF, the share that a free form of all signals
    would take beyond that noise, where it matters: a form of noisy signals takes a part of it.
    at_turns: DOF with friction at which what matters is where they turn only; they count neither
    for beyond_noise nor for form_matters.
    nearest: what takes much of what is left, and was refused, as a clause; empty if nothing does.
    exchange: what columns have to be for a model without effects to explain as much. outputs: how
    close to the outputs a model without effects is that is fitted to them, in per cent of these, if
    it is as close as with the effects found, else nan.
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
    outputs: float

    @property
    def doubtful(self) -> bool:
        """Whether any name is uncertain."""
        return any(law.doubtful for law in self.laws)

    @property
    def lacks_something(self) -> bool:
        """Whether the model lacks what its numbers may hold a part of, beyond their intervals."""
        inexact = any(law.inexact for law in self.laws)
        more = self.form_matters or self.lacking or self.beyond_noise
        return self.doubtful or inexact or bool(more) or self.exchange is not None

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
        """What the model leaves of the force, in a clause."""
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
        """Where a free form takes what matters: DOF, what the model and the form leave, in per
        cent of the force in the fitted rows."""
        every = zip(self.dof, self.fitted, self.free_form, strict=True)
        return [one for one in every if one[0] in self.form_matters]

    @property
    def lacks(self) -> list[str]:
        """What no law of the table describes at a DOF, in a clause each."""
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
    by_form = _worth(trace, PERCENT * trace.rows.missing, PERCENT * any_law)
    beyond = _beyond_noise(trace, after)
    # What an effect would take of noise alone is no hint of it.
    nearest = _nearest(trace) if beyond or by_form else ""
    turning = _only_at_turns(trace)
    return ForceOutcome(
        _laws(trace),
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
        _outputs(trace, after),
    )


def _lacking(trace: ForceTrace) -> dict[str, float]:
    """Return, by DOF, the share of the squared missing force that a function of motion foretells.

    DOF are left out where it is less than a free form has to take to be added: `least_free_gain` of
    the squares, and `least_force` of the inputs' force.
    """
    return _worth(trace, *trace.unseen)


def _worth(trace: ForceTrace, left: Array, form: Array) -> dict[str, float]:
    """Return, by DOF, the share that a form takes of the squares that are left, where it matters.

    left, form (n,): missing force without and with it, or what is noise, in per cent of the inputs'
    force.
    """
    options, found = trace.options, {}
    for name, before, after in zip(trace.places.dof, left, form, strict=True):
        share = 1.0 - (after / before) ** 2 if before > 0.0 else 0.0
        if share > options.least_free_gain and before - after > PERCENT * options.least_force:
            found[name] = float(share)
    return found


def _beyond_noise(trace: ForceTrace, after: PooledError) -> dict[str, float]:
    """Return, by DOF, the share of the squared missing force beyond the noise of the outputs, where
    it matters.

    The noise may be `much_left` times what it is estimated to be. It is taken for white, and that
    of a coarse encoder in slow motion, whose readings stay and jump, has more at low frequencies.
    """
    return _worth(trace, after.force_percent, trace.options.much_left * after.noise_percent)


def _only_at_turns(trace: ForceTrace) -> tuple[str, ...]:
    """Return the DOF with friction at which noise explains all that is missing between their turns,
    and not all that is missing in the fitted rows.

    Where friction holds a DOF for a moment, its force is what acts on it, which no law tells.
    """
    if trace.between is None:
        return ()
    there, between = (
        _worth(trace, PERCENT * rows.missing, PERCENT * rows.noise)
        for rows in (trace.rows, trace.between)
    )
    names = trace.places.dof
    rubbed = {n for _, f in trace.found.point.rubbed(trace.places) for n in np.array(names)[f != 0]}
    return tuple(n for n in names if n in rubbed and n in there and n not in between)


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


def force_summary(trace: ForceTrace) -> dict[str, Any]:
    """Return the result as dicts, lists, finite numbers and text, for JSON; None replaces nan.

    effects: name, class, where, parameters, evidence, support and alternatives of each; one that
    is not told from effects of another class or place has the class ambiguous. validation: metric,
    before, after, noise_floor (None if the noise is not stated), percent, force_percent.
    """
    found = force_outcome(trace)
    force = [float(np.sqrt(np.mean(e.force_percent**2))) for e in (found.before, found.after)]
    dof = trace.places.dof
    plain: dict[str, Any] = plain_json(
        {
            "effects": [_effect(law) for law in found.laws],
            "validation": {
                "metric": found.metric,
                "about": ABOUT[found.metric].format(limit=trace.limit_hz),
                "before": found.before_rms,
                "after": found.after_rms,
                "noise_floor": found.floor,
                "percent": {
                    "before": dict(zip(dof, found.before.percent, strict=True)),
                    "after": dict(zip(dof, found.after.percent, strict=True)),
                },
                "force_percent": {"before": force[0], "after": force[1]},
                "per_dof": {
                    name: {
                        "unit": trace.places.dof_units[i],
                        "before": found.before.error[i],
                        "after": found.after.error[i],
                        "noise_sd": trace.noise_sd[i],
                        "noise_stated": trace.noise_stated,
                        "force_percent": {
                            "before": found.before.force_percent[i],
                            "after": found.after.force_percent[i],
                            "fitted": found.fitted[i],
                            "free_form": found.free_form[i],
                            "noise": found.after.noise_percent[i],
                        },
                    }
                    for i, name in enumerate(dof)
                },
                "per_record": [
                    {
                        "record": a.record,
                        "seconds": a.seconds,
                        "force_percent": {
                            "before": dict(zip(dof, _percent(b), strict=True)),
                            "after": dict(zip(dof, _percent(a), strict=True)),
                        },
                    }
                    for b, a in zip(trace.before, trace.after, strict=True)
                ],
            },
            "unexplained": {
                "found": found.verdict,
                "doubtful": found.doubtful,
                "lacking": found.lacking,
                "beyond_noise": found.beyond_noise,
                "at_turns": list(found.at_turns),
                "lacks_something": found.lacks_something,
                "outputs_percent": found.outputs,
                "exchanged": None if found.exchange is None else found.exchange.words,
                "nearest": [
                    {
                        **_named(r),
                        "statistic_sd": r.gain.statistic,
                        "share": r.share,
                        "contradicted": not r.gain.elsewhere,
                    }
                    for r in trace.found.nearest
                ],
                "given_up": list(trace.found.dropped),
                "unsettled_records": [e.record for e in trace.after if not e.settled],
            },
            "band_hz": [0.0, trace.limit_hz],
            "covariance": parameter_covariance(
                model_with_effects(trace),
                list(trace.found.point.parameters.names),
                trace.correlations,
            ),
        }
    )
    return plain


def declared_effects(trace: ForceTrace) -> list[tuple[Effect, dict[str, EffectParameter]]]:
    """Return the effects that the model declared already, with their fitted parameters."""
    new = {r.placed.effect.identity for r in trace.found.rated}
    pairs = zip(trace.found.point.placed, _parameters(trace), strict=True)
    return [(p.effect, values) for p, values in pairs if p.effect.identity not in new]


def model_with_effects(trace: ForceTrace) -> ModelConfig:
    """Return the refitted model with its effects, values with standard errors."""
    point, config = trace.found.point, trace.config
    free, values = point.parameters, point.values
    known = np.minimum(free.worth, free.prior_sd)
    parameters = dict(config.parameters)
    sd = trace.errors[: len(values)]
    for name, value, error, before in zip(free.names, values, sd, known, strict=True):
        told = error < _MOST_ERROR_SHARE * before
        parameters[name] = parameters[name].model_copy(
            update={"value": float(value), "se": float(error) if told else None}
        )
    effects = tuple(
        ModelEffect(effect=p.effect.key, where=p.effect.where, parameters=values)
        for p, values in zip(point.placed, _parameters(trace), strict=True)
    )
    return config.model_copy(update={"parameters": parameters, "effects": effects})


def _parameters(trace: ForceTrace) -> list[dict[str, EffectParameter]]:
    """Return the parameters of each effect of the found model, by name, amplitudes first.

    What is held, as the depth of a plain law, has no standard error.
    """
    at, found = len(trace.found.point.values), []
    for p in trace.found.point.placed:
        errors = by_value(p, trace.errors[at : at + numbers_of(p)], np.inf)
        at += numbers_of(p)
        found.append(
            {
                q.name: EffectParameter(value=value, unit=q.unit, se=_finite(error))
                for q, value, error in zip(p.quantities, p.values, errors.tolist(), strict=True)
            }
        )
    return found


def _laws(trace: ForceTrace) -> tuple[FoundLaw, ...]:
    values = {
        p.effect.identity: own
        for p, own in zip(trace.found.point.placed, _parameters(trace), strict=True)
    }
    errors = {
        p.effect.identity: own
        for p, own in zip(trace.found.point.placed, trace.force_errors, strict=True)
    }
    laws = []
    pooled = pooled_errors(trace)
    grew = _grew(*(e.force_percent for e in pooled)), _grew(*(e.percent for e in pooled))
    known = {p.effect.identity for p in trace.found.point.placed}
    surely = trace.options.standard_errors
    floors, unseen = _floors(*pooled, trace.options.alike), _left_unseen(trace, *pooled)
    displaced = tuple(name for name, _, limit in at_limits(trace.found.point) if limit)
    if np.isinf(floors) and _confirmed_by_force(trace, *pooled):
        floors = float("nan")
    count = len(trace.found.rated)
    outputs = _outputs(trace, pooled[1])
    crowded = count if count >= trace.options.most_effects else 0
    for rated, left, leaning in zip(
        trace.found.rated, trace.left_share, trace.leaning, strict=True
    ):
        own = _kind(rated)
        # What was found later besides is no alternative any more.
        rivals = [r for r in rated.alternatives if r.placed.effect.identity not in known]
        same = tuple(r for r in rivals if _kind(r) == own)
        others = tuple(r for r in rivals if _kind(r) != own)
        own_values = values[rated.placed.effect.identity]
        laws.append(
            FoundLaw(
                rated,
                own_values,
                rated.support,
                others,
                same,
                left,
                leaning,
                unseen,
                trace.options.least_gain,
                trace.curves.get(rated.placed.effect.identity),
                grew,
                floors,
                is_told(errors[rated.placed.effect.identity], trace.options),
                surely,
                trace.options.agreement,
                trace.options.alike,
                displaced,
                trace.impossible.get(rated.placed.effect.identity, ()),
                "" if trace.exchange is None else trace.exchange.words,
                crowded,
                outputs,
            )
        )
    return tuple(laws)


def _outputs(trace: ForceTrace, after: PooledError) -> float:
    """Return how close a model without effects is to the outputs, in per cent, if it is as close as
    the found one, else nan."""
    fitted = trace.outputs
    effects = len(trace.found.rated)
    if fitted is None or not as_close(fitted, after, effects, trace.options):
        return float("nan")
    return float(fitted.percent.max())


def _left_unseen(trace: ForceTrace, before: PooledError, after: PooledError) -> float:
    """Return the share of the squared missing force in rows that neither fitted nor chose that is
    left beyond the noise of the outputs, at the DOF where the found effects take most of it.

    0 where that does not matter, and where friction holds the DOF for a moment.
    """
    taken = before.force_percent**2 - after.force_percent**2
    most = int(np.argmax(taken))
    name = trace.places.dof[most]
    beyond = _beyond_noise(trace, after)
    if name not in beyond or name in _only_at_turns(trace):
        return 0.0
    left = after.force_percent[most] ** 2 - after.noise_percent[most] ** 2
    return float(left / (left + max(taken[most], 0.0)))


def _floors(before: PooledError, after: PooledError, inexact: float) -> float:
    """Return the largest error of a free run over its floor, nan without them.

    Of a right law, what its equation may be wrong by is left, as a share of the error before:
    DOF with less do not count. Where the free run converges no more, it is infinitely far.
    """
    if np.any(np.isfinite(before.error) & np.isnan(after.error)):
        return float("inf")
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(after.error > inexact * before.error, after.error / after.floor, np.nan)
    known = ratios[np.isfinite(ratios)]
    return float(known.max()) if len(known) else float("nan")


def _confirmed_by_force(trace: ForceTrace, before: PooledError, after: PooledError) -> bool:
    """Return whether rows that neither fitted nor chose miss no more force than any law leaves, or
    next to nothing of what they missed before.

    A plant between two stops can be chaotic: then no free run converges, of the right law either. A
    free form of all signals, in the fitted rows, stands for any law; where it leaves far more than
    the noise of the outputs too, something moves that no signal shows, and none is confirmed.
    """
    room, squares = 1.0 - trace.options.least_free_gain, after.force_percent**2
    as_any = bool(np.all(room * squares <= (PERCENT * trace.rows.any_law) ** 2))
    beyond = _beyond_noise(trace, after)
    little = trace.options.least_gain**2 * np.sum(before.force_percent**2)
    return bool((as_any and not beyond) or squares.sum() <= little)


def _grew(before: Array, after: Array) -> bool:
    """Return whether errors of all DOF together grew; nan, of no simulation, did not."""
    return bool(np.linalg.norm(after) > np.linalg.norm(before))


def _kind(rated: Rated) -> tuple[str, tuple[str, ...]]:
    return rated.placed.effect.effect_class, rated.placed.effect.where


def _percent(error: Any) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(PERCENT * error.force / error.force_acting)


def _effect(law: FoundLaw) -> dict[str, Any]:
    effect, rated = law.placed.effect, law.rated
    evidence: dict[str, Any] = {
        "equation": effect.equation,
        "statistic_sd": rated.gain.statistic,
        "asked": "blocks",
        "share": rated.share,
        "force_share": rated.force,
        "other_records": [None if not math.isfinite(g) else g > 0.0 for g in rated.gain.others],
        "laws_not_told_apart": [_named(r) for r in law.laws],
        "left_share": law.left_share,
        "doubtful": law.doubtful,
        "doubts": list(law.doubts),
        "curve": None
        if law.curve is None
        else {"signals": list(depends_on(law.curve.placed.effect)), "share": law.curve.share},
        "absorbed_by": effect.absorbed_by,
        "told_apart_by": effect.told_apart_by,
    }
    if law.free:
        evidence["signals"] = list(depends_on(effect))
    members: Sequence[Rated] = (rated, *law.alternatives) if law.alternatives else ()
    supports = (law.support, *(r.support for r in law.alternatives))
    return {
        "name": law.name,
        "class": "ambiguous" if law.alternatives else effect.effect_class,
        "where": list(effect.where),
        "parameters": {
            name: {"value": p.value, "se": p.se, "unit": p.unit}
            for name, p in law.parameters.items()
        },
        "support": sum(
            {
                _kind(r): s for r, s in zip((rated, *law.alternatives), supports, strict=True)
            }.values()
        ),
        "alternatives": [
            {**_named(r), "support": s} for r, s in zip(members, supports, strict=False)
        ],
        "evidence": evidence,
    }


def _named(rated: Rated) -> dict[str, Any]:
    effect = rated.placed.effect
    return {"name": effect.name, "class": effect.effect_class, "where": list(effect.where)}


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
