"""Check the model with its effects on data that neither fitted nor chose it.

These checks concern all effects at once: what the model still lacks, where its free-run simulation
goes, and whether a model without effects does as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...value_with_interval import PERCENT, percent
from ..force_balance.free_numbers import at_limits
from ..force_balance.reported_errors import PooledError
from ..force_checks.output_error_fit import as_close
from ..search_options import SearchOptions
from .trace_imported import ForceTrace, pooled_errors

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ModelCheck:
    """The checks of a model with its effects, on the last quarter of each record.

    unseen: share of the squared missing force that is left beyond the noise of the outputs.
    misses_more, farther: whether the missing force, and the error of the free run, are larger than
    without effects. floors: largest error of the free run over the error that the stated noise
    leaves; nan without one, infinite if the free run converges only without effects and the force
    does not confirm these. displaced: parameters of the model at a limit of their range.
    exchanged: the exchange of columns with which a model without effects explains as much, in
    words; empty without one. crowded: the number of effects if the search ended at its maximum,
    else 0. outputs: distance of a model without effects, fitted to the outputs, from these, in per
    cent, if it is as close as the model with effects; else nan.
    """

    options: SearchOptions
    unseen: float = 0.0
    misses_more: bool = False
    farther: bool = False
    floors: float = float("nan")
    displaced: tuple[str, ...] = ()
    exchanged: str = ""
    crowded: int = 0
    outputs: float = float("nan")

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why the names of all effects are uncertain, as clauses."""
        found = []
        if self.unseen > self.options.least_gain:
            found.append(
                f"{percent(self.unseen)} of the squared missing force is left in the last quarter "
                "of each record, which no fit used"
            )
        if self.misses_more:
            found.append(
                "in the last quarter of each record, which no fit used, the model misses more "
                "force with the effects than without them"
            )
        if self.farther:
            found.append(
                "in the last quarter of each record, which no fit used, the free-run simulation is "
                "farther from the outputs with the effects than without them"
            )
        if np.isinf(self.floors):
            found.append(
                "the free-run simulation diverges with the effects, and the force does not confirm "
                "them"
            )
        elif self.floors > self.options.agreement:
            found.append(
                f"the error of the free-run simulation is {self.floors:.2g} times what the noise "
                "explains"
            )
        if self.displaced:
            found.append(
                f"with the effects, {' and '.join(self.displaced)} ended at the limit of its range"
            )
        if self.crowded:
            found.append(
                f"the search ended at its maximum of {self.crowded} effects: several of them may "
                "together stand for one effect that the table lacks"
            )
        if self.exchanged:
            found.append(f"the model without effects explains as much if {self.exchanged}")
        return (*found, *self.close_without_effects)

    @property
    def close_without_effects(self) -> tuple[str, ...]:
        """The doubt that a model without effects is as close to the outputs, if it is."""
        if not np.isfinite(self.outputs):
            return ()
        return (
            f"a model without effects, fitted to the outputs, is within {self.outputs:.2g} % of "
            "them, as close as the model with the effects",
        )


def check_model(trace: ForceTrace) -> ModelCheck:
    """Return the checks of the found model of a trace."""
    before, after = pooled_errors(trace)
    floors = _floors(before, after, trace.options.alike)
    if np.isinf(floors) and _confirmed_by_force(trace, before, after):
        floors = float("nan")
    count = len(trace.found.rated)
    return ModelCheck(
        trace.options,
        unseen=_left_unseen(trace, before, after),
        misses_more=_grew(before.force_percent, after.force_percent),
        farther=_grew(before.percent, after.percent),
        floors=floors,
        displaced=tuple(name for name, _, limit in at_limits(trace.found.point) if limit),
        exchanged="" if trace.exchange is None else trace.exchange.words,
        crowded=count if count >= trace.options.most_effects else 0,
        outputs=_distance_without_effects(trace, after),
    )


def taken_by_form(trace: ForceTrace, left: Array, form: Array) -> dict[str, float]:
    """Return, by DOF, the share of the squared missing force that a form takes, where relevant.

    left, form (n,): missing force without and with the form, in per cent of the inputs' force; a
    form can also be what noise explains.
    """
    options, found = trace.options, {}
    for name, before, after in zip(trace.places.dof, left, form, strict=True):
        share = 1.0 - (after / before) ** 2 if before > 0.0 else 0.0
        if share > options.least_free_gain and before - after > PERCENT * options.least_force:
            found[name] = float(share)
    return found


def beyond_noise(trace: ForceTrace, after: PooledError) -> dict[str, float]:
    """Return, by DOF, the share of the squared missing force beyond the outputs' noise, where
    relevant.

    The noise may be `much_left` times its estimate. The estimate assumes white noise, and that of a
    coarse encoder in slow motion, whose readings stay and jump, has more at low frequencies.
    """
    return taken_by_form(trace, after.force_percent, trace.options.much_left * after.noise_percent)


def missing_only_at_turns(trace: ForceTrace) -> tuple[str, ...]:
    """Return the DOF with friction at which noise explains what is missing between the turns, but
    not what is missing in all fitted rows.

    Where friction holds a DOF for a moment, its force equals whatever acts on the DOF. No law of
    the motion predicts it.
    """
    if trace.between is None:
        return ()
    there, between = (
        taken_by_form(trace, PERCENT * rows.missing, PERCENT * rows.noise)
        for rows in (trace.rows, trace.between)
    )
    names = trace.places.dof
    rubbed = _dofs_with_friction(trace)
    return tuple(n for n in names if n in rubbed and n in there and n not in between)


def _dofs_with_friction(trace: ForceTrace) -> set[str]:
    names = np.array(trace.places.dof)
    return {n for _, f in trace.found.point.rubbed(trace.places) for n in names[f != 0]}


def _distance_without_effects(trace: ForceTrace, after: PooledError) -> float:
    fitted, effects = trace.outputs, len(trace.found.rated)
    if fitted is None or not as_close(fitted, after, effects, trace.options):
        return float("nan")
    return float(fitted.percent.max())


def _left_unseen(trace: ForceTrace, before: PooledError, after: PooledError) -> float:
    """Return the share of the squared missing force that is left beyond the noise of the outputs,
    at the DOF where the effects remove most of it.

    It is 0 where that is not relevant, and where friction holds the DOF for a moment.
    """
    taken = before.force_percent**2 - after.force_percent**2
    most = int(np.argmax(taken))
    name = trace.places.dof[most]
    if name not in beyond_noise(trace, after) or name in missing_only_at_turns(trace):
        return 0.0
    left = after.force_percent[most] ** 2 - after.noise_percent[most] ** 2
    return float(left / (left + max(taken[most], 0.0)))


def _floors(before: PooledError, after: PooledError, inexact: float) -> float:
    """Return the largest error of a free run over its floor, nan without a floor.

    A right law leaves what its equation may be wrong by, as a share of the error before: DOF with
    less do not count. It is infinite where the free run no longer converges.
    """
    if np.any(np.isfinite(before.error) & np.isnan(after.error)):
        return float("inf")
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(after.error > inexact * before.error, after.error / after.floor, np.nan)
    known = ratios[np.isfinite(ratios)]
    return float(known.max()) if len(known) else float("nan")


def _confirmed_by_force(trace: ForceTrace, before: PooledError, after: PooledError) -> bool:
    """Return whether the effects leave no more missing force than any law would, or next to nothing
    of it.

    A plant between two stops can be chaotic: then no free run converges, not even with the right
    law. A free form of all signals, in the fitted rows, stands for any law. Where it leaves far
    more than the noise of the outputs, something moves that no signal shows, and nothing is
    confirmed.
    """
    room, squares = 1.0 - trace.options.least_free_gain, after.force_percent**2
    as_any = bool(np.all(room * squares <= (PERCENT * trace.rows.any_law) ** 2))
    little = trace.options.least_gain**2 * np.sum(before.force_percent**2)
    return bool((as_any and not beyond_noise(trace, after)) or squares.sum() <= little)


def _grew(before: Array, after: Array) -> bool:
    """Return whether errors of all DOF together grew; nan, without a simulation, did not."""
    return bool(np.linalg.norm(after) > np.linalg.norm(before))
