"""Write the result of a trace of imported records as JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....model.effects.freeform import depends_on
from ...json_data import plain_json
from ...value_with_interval import PERCENT
from ..force_search.rated_candidate import Rated
from ..parameter_covariance import parameter_covariance
from .force_trace_outcome import force_outcome, kind
from .found_law import FoundLaw
from .model_with_effects import model_with_effects
from .trace_imported import ForceTrace

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
                "outputs_percent": found.check.outputs,
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
            {kind(r): s for r, s in zip((rated, *law.alternatives), supports, strict=True)}.values()
        ),
        "alternatives": [
            {**_named(r), "support": s} for r, s in zip(members, supports, strict=False)
        ],
        "evidence": evidence,
    }


def _named(rated: Rated) -> dict[str, Any]:
    effect = rated.placed.effect
    return {"name": effect.name, "class": effect.effect_class, "where": list(effect.where)}


def _percent(error: Any) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(PERCENT * error.force / error.force_acting)
