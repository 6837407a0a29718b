"""Identify a system from input to output without a known controller, as for imported data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..model.second_order import StateSpace
from .nonparametric.frequency_response import ResponseEstimate, frequency_response
from .nonparametric.markov_parameters import convolve, most_taps, nested_estimates
from .nonparametric.records_without_a_model import findings_of_records
from .options import Options
from .records.drop_short_records import drop_short_records, left_out_remarks
from .records.held_out_rows import HeldOut, held_out_rows
from .records.record import IdentificationError, OperatingPoint, Record
from .results import ImpulseLength, OpenLoopPoint
from .subspace.fit_percent import nrmse_fit_percent
from .subspace.held_out_simulation import HoldOut
from .subspace.plant_from_loop import IdentifiedPlant
from .subspace.prediction_error_method import (
    RefinedModel,
    initial_state_and_offset,
    refine_innovations,
    refine_output_error,
)
from .subspace.response_uncertainty import disagreements, modes, response_with_errors
from .subspace.signs_of_records import records_of_other_sign
from .subspace.simulation import InnovationModel, simulate, spectral_radius
from .subspace.starting_models import StartingModels, starting_models

Array = NDArray[np.float64]

HIGHEST_ORDER = 20
PATIENCE = 4
"""Orders in a row without a better validation error after which no higher order is fitted."""
TRIAL_ROWS = 20_000
"""Rows to which the models of every order are fitted; the chosen orders are fitted to all."""
ROWS_A_TAP = 4
MOST_TAPS = 200
FEWEST_TAPS = 2 * HIGHEST_ORDER + 1
"""Shortest impulse response that is tried: its Hankel matrix has HIGHEST_ORDER singular values."""
VALIDATION_SHARE = 0.25
BLOCKS = 8
"""Blocks in time from which the standard error of a validation error is estimated."""
BINS = 180
SETTLED = 1e-3
"""Least scale of an output's errors, over its rms in the whole record."""
_ROUNDING = 1e-12
"""Relative squared error below which models of data without noise are equally good."""
_DIVERGED = 1e12
"""Relative squared error above which a model is rejected: its predictor diverges."""


@dataclass(frozen=True)
class _Fitted:
    """The models of one order; None: there is none."""

    simulator: RefinedModel | None
    predictor: InnovationModel | None


def identify_open_loop(
    point: OperatingPoint, options: Options, progress: Callable[[float], None]
) -> OpenLoopPoint:
    """Identify one operating point; `progress` is called with the share of the work done.

    Models of every order are estimated in closed form (Ho-Kalman, observer Markov parameters), and
    refined by the prediction-error method from each of these starts: one simulates from the inputs
    alone, one predicts a step ahead. Their orders are chosen by validation: models of every order
    are fitted to the first three quarters of the training rows and compared on the last. So is the
    length of the impulse response. The held-out rows (`options.holdout`) only measure the fit. Both
    begin where motion is left behind them (`held_out_rows`).

    Records of a loop with an unknown controller have the predictor only, which is consistent there:
    `model` is the predictor's. So it is if no stable model simulates the records. An unstable model
    has no simulated outputs. Whether outputs drive the inputs, and whether anything else does, is
    tested for all records: `doubts` has the consequences.

    Raises IdentificationError for records that are too short or constant outputs.
    """
    # The impulse response is at most half as long as the shortest record.
    records, too_short = drop_short_records(point.records, 2 * MOST_TAPS + 1)
    held_out = [held_out_rows(r.y, r.v, options.holdout) for r in records]
    stops = [held.start for held in held_out]
    centred = [_centred(r, stop) for r, stop in zip(records, stops, strict=True)]
    training = [r.rows(0, stop) for r, stop in zip(centred, stops, strict=True)]
    part_stops = [held_out_rows(r.y, r.v, VALIDATION_SHARE).start for r in training]

    _check_outputs([r.rows(0, stop) for r, stop in zip(training, part_stops, strict=True)])
    origins, feedback = findings_of_records(records)
    spectra = _spectra(training, options)
    impulse = _impulse_length(training, part_stops, options)
    trial, simulated, predicted = _by_order(training, part_stops, impulse.taps, options, progress)
    cost = _state_cost(training)
    predictor_order = options.order or _smallest_good(predicted, cost)
    order = options.order or (_smallest_good(simulated, cost) if simulated else predictor_order)

    starts = starting_models(training, impulse.taps, options.markov, HIGHEST_ORDER)
    simulator = _fitted_simulator(order, starts, training, trial[order])
    progress(0.9)
    alike = (
        simulator
        if predictor_order == order
        else _fitted_simulator(predictor_order, starts, training, trial[predictor_order])
    )
    predictor, predictor_fit = _fitted_predictor(
        predictor_order, starts, training, trial[predictor_order], alike
    )
    fit = simulator or predictor_fit
    stable = spectral_radius(fit.model.A) < 1.0
    mode_lists = (
        modes(fit.model, fit.covariance),
        modes(predictor.model, predictor_fit.covariance),
    )
    holdout = tuple(
        _hold_out(original, record, held, fit.model if stable else None, predictor)
        for original, record, held in zip(records, centred, held_out, strict=True)
    )
    return OpenLoopPoint(
        beam_m=point.beam_m,
        records=tuple(r.name for r in records),
        markov={} if starts.markov is None else {options.markov: starts.markov},
        singular_values=(
            {}
            if starts.decomposition is None
            else {options.markov: starts.decomposition.singular_values}
        ),
        impulse=impulse,
        order=len(fit.model.A),
        predictor_order=predictor_order,
        validation_error=_curve(simulated),
        predictor_validation_error=_curve(predicted),
        model=fit.model,
        covariance=fit.covariance,
        stable=stable,
        modes=mode_lists[0],
        predictor=predictor,
        predictor_modes=mode_lists[1],
        response=response_with_errors(IdentifiedPlant(fit.model), fit.covariance, spectra.freq_hz),
        from_spectra=spectra,
        holdout=holdout,
        remarks=(
            *(f"{r.name}: {text}" for r in records for text in r.remarks),
            *left_out_remarks(too_short),
            *feedback.remarks,
            *(
                f"record '{r.name}': {held.remark}"
                for r, held in zip(records, held_out, strict=True)
                if held.remark is not None
            ),
            *([f"no Markov parameters: {starts.no_markov}"] if starts.no_markov else []),
            *([] if stable else [_UNSTABLE]),
            *(disagreements(*mode_lists, ("simulation", "prediction")) if simulator else ()),
        ),
        doubts=(*records_of_other_sign(holdout, records[0].output_names), *feedback.doubts),
        origins=origins,
        feedback=records[0].feedback,
    )


_UNSTABLE = (
    "the model is unstable, so it predicts one step ahead and does not simulate; whether the plant "
    "is unstable is judged by the intervals of its modes"
)


def _by_order(
    training: Sequence[Record],
    part_stops: Sequence[int],
    taps: int,
    options: Options,
    progress: Callable[[float], None],
) -> tuple[dict[int, _Fitted], dict[int, Array], dict[int, Array]]:
    """Fit models of rising order to the rows before `part_stops`; return their validation errors.

    The search ends if PATIENCE orders in a row are no better than a lower one.
    """
    parts = [r.rows(0, stop) for r, stop in zip(training, part_stops, strict=True)]
    starts = starting_models(parts, taps, options.markov, HIGHEST_ORDER)
    few = _first_rows(parts, TRIAL_ROWS)
    cost = _state_cost(training)
    trial: dict[int, _Fitted] = {}
    errors: tuple[dict[int, Array], dict[int, Array]] = ({}, {})
    best_order = [0, 0]
    for n in [options.order] if options.order else range(1, HIGHEST_ORDER + 1):
        trial[n] = found = _trial(n, starts, few)
        if found.simulator is not None:
            run = _simulated(found.simulator.model, parts)
            _add_errors(errors[0], n, training, part_stops, run)
        if found.predictor is not None:
            run = _predicted(found.predictor, parts)
            _add_errors(errors[1], n, training, part_stops, run)
        progress(0.7 * n / HIGHEST_ORDER)
        for kind in range(2):
            best = errors[kind].get(best_order[kind])
            here = errors[kind].get(n)
            if here is not None and (
                best is None or np.log(here.mean()) < np.log(best.mean()) - cost
            ):
                best_order[kind] = n
        if n - max(best_order) >= PATIENCE:
            break
    if not errors[1]:
        # Without a predictor of any order: the reason of the first.
        starts.predictor(options.order or 1)
    return trial, *errors


def _trial(order: int, starts: StartingModels, records: Sequence[Record]) -> _Fitted:
    """Return nearly the best models of one order, after a few steps from each start."""
    simulator = _best(refine_output_error(s, records, trial=True) for s in starts.simulators(order))
    for start in starts.predictors(order):
        found = refine_innovations(start, records, trial=True)
        if found is not None:
            return _Fitted(simulator, found[0])
    return _Fitted(simulator, None)


def _fitted_simulator(
    order: int, starts: StartingModels, records: Sequence[Record], trial: _Fitted
) -> RefinedModel | None:
    """Return the best model of one order that simulates, from all starts and the trial's."""
    simulators = list(starts.simulators(order))
    if trial.simulator is not None:
        simulators.append(trial.simulator.model)
    return _best(refine_output_error(start, records) for start in simulators)


def _fitted_predictor(
    order: int,
    starts: StartingModels,
    records: Sequence[Record],
    trial: _Fitted,
    simulator: RefinedModel | None,
) -> tuple[InnovationModel, RefinedModel]:
    """Return the best predictor of one order, from all starts, the trial's, and the simulator.

    Raises IdentificationError if there is none.
    """
    predictors = list(starts.predictors(order))
    if trial.predictor is not None:
        predictors.append(trial.predictor)
    if simulator is not None:
        # Noise of the sensors alone: a predictor that does not use the measured outputs.
        silent = np.zeros(simulator.model.C.T.shape)
        predictors.append(InnovationModel(simulator.model, silent, simulator.error_covariance))
    best: tuple[InnovationModel, RefinedModel] | None = None
    for start in predictors:
        found = refine_innovations(start, records)
        if found is not None and (best is None or found[1].criterion < best[1].criterion):
            best = found
    if best is None:
        raise IdentificationError(
            f"expected a predictor of order {order}, found none; choose another order"
        )
    return best


def _best(fits: Iterable[RefinedModel | None]) -> RefinedModel | None:
    found = [fit for fit in fits if fit is not None]
    return min(found, key=lambda fit: fit.criterion, default=None)


def _first_rows(records: Sequence[Record], rows: int) -> list[Record]:
    """Return the first rows of every record, about `rows` in all."""
    share = min(1.0, rows / sum(len(r.y) for r in records))
    return [r.rows(0, max(round(share * len(r.y)), 1)) for r in records]


def _centred(record: Record, stop: int) -> Record:
    """Subtract the means of the first `stop` rows: the level is not modelled."""
    return replace(
        record,
        v=record.v - record.v[:stop].mean(axis=0),
        y=record.y - record.y[:stop].mean(axis=0),
        at_rest=False,
    )


def _check_outputs(parts: Sequence[Record]) -> None:
    for record in parts:
        for name, moves in zip(record.output_names, np.ptp(record.y, axis=0) > 0, strict=True):
            if not moves:
                raise IdentificationError(
                    f"record '{record.name}': expected outputs that vary, found '{name}' constant "
                    f"over the {len(record.y)} training rows"
                )


def _impulse_length(
    training: Sequence[Record], part_stops: Sequence[int], options: Options
) -> ImpulseLength:
    """Return the length of the impulse response: the given one, or the one with the least error.

    Candidates are the longest that the rows before `part_stops` determine, and its halves. Each is
    estimated from these rows, and predicts the outputs of the rows after them from the inputs. The
    shortest one within one standard error of the best is chosen.
    """
    Ts_s = training[0].Ts_s
    if options.impulse_s is not None:
        return ImpulseLength(max(3, round(options.impulse_s / Ts_s)), Ts_s, "given", {})
    parts = [r.rows(0, stop) for r, stop in zip(training, part_stops, strict=True)]
    lengths = [_most_taps(parts)]
    while lengths[-1] // 2 >= FEWEST_TAPS:
        lengths.append(lengths[-1] // 2)
    errors: dict[int, Array] = {}
    # Where the excitation determines no length, the model starts from the predictor alone.
    with suppress(IdentificationError):
        for length, g in nested_estimates(parts, lengths, options.markov).items():
            _add_errors(errors, length, training, part_stops, _convolved(g, parts))
    if not errors:
        return ImpulseLength(lengths[0], Ts_s, "rule", {})
    by_length = {length: float(np.sqrt(blocks.mean())) for length, blocks in errors.items()}
    return ImpulseLength(_smallest_good(errors, 0.0), Ts_s, "validation", by_length)


def _most_taps(records: Sequence[Record]) -> int:
    rows = sum(len(r.y) for r in records)
    shortest = min(len(r.y) for r in records)
    enough = min(rows // (ROWS_A_TAP * records[0].v.shape[1]), most_taps(records))
    return int(min(MOST_TAPS, enough, shortest // 2))


Run = Callable[[int, Record], Array]
"""Return a model's output for a record and its number; records may share a name."""


def _simulated(model: StateSpace, known: Sequence[Record]) -> Run:
    """Return a function that simulates a record; `known` rows determine its start and offset."""
    starts = [initial_state_and_offset(model, r.v, r.y) for r in known]
    return lambda number, record: simulate(model, record.v, starts[number][0]) + starts[number][1]


def _convolved(g: Array, known: Sequence[Record]) -> Run:
    """Return a function that predicts by Markov parameters; `known` rows determine the offset."""
    first = len(g) - 1
    offsets = [(r.y - convolve(r.v, g))[first:].mean(axis=0) for r in known]
    return lambda number, record: convolve(record.v, g) + offsets[number]


def _predicted(model: InnovationModel, known: Sequence[Record]) -> Run:
    predictor = model.predictor()
    starts = [initial_state_and_offset(predictor, np.hstack([r.v, r.y]), r.y) for r in known]
    return lambda number, record: (
        simulate(predictor, np.hstack([record.v, record.y]), starts[number][0]) + starts[number][1]
    )


def _add_errors(
    errors: dict[int, Array], order: int, records: Sequence[Record], starts: Sequence[int], run: Run
) -> None:
    """Add the squared error relative to the outputs' rms, in BLOCKS blocks of time."""
    blocks = np.zeros(BLOCKS)
    for number, (record, start) in enumerate(zip(records, starts, strict=True)):
        # The scale has a lower bound: an output may be at rest in the validation rows.
        size = np.maximum(record.y[start:].std(axis=0), SETTLED * record.y.std(axis=0))
        with np.errstate(over="ignore", invalid="ignore"):
            error = (record.y - run(number, record))[start:] / size
            blocks += [np.mean(part**2) for part in np.array_split(error, BLOCKS)]
    if np.all(blocks < _DIVERGED):  # also rejects nan
        errors[order] = np.maximum(blocks / len(records), _ROUNDING)


def _smallest_good(possible: Mapping[int, Array], state_cost: float) -> int:
    """Return the smallest order (or length) whose error is not significantly above the best one's.

    That is: the mean error is larger by at most one standard error of the difference, compared
    block by block, or its logarithm by at most `state_cost` for each state less.
    """
    if not possible:
        raise IdentificationError(
            "expected a model of at least one order that predicts the validation rows, found none; "
            "record more data"
        )
    best = min(possible, key=lambda n: float(possible[n].mean()))

    def close(order: int) -> bool:
        worse = possible[order] - possible[best]
        chance = worse.std(ddof=1) / np.sqrt(BLOCKS)
        price = possible[best].mean() * np.expm1(state_cost * (best - order))
        return bool(worse.mean() <= max(chance, price))

    return next(order for order in sorted(possible) if close(order))


def _state_cost(records: Sequence[Record]) -> float:
    """Return the least gain in log mean square error that justifies one more state.

    It is the BIC penalty of the state's parameters, one for each input and output.
    """
    m, p = records[0].y.shape[1], records[0].v.shape[1]
    samples = sum(r.y.size for r in records)
    return float((m + p) * np.log(samples) / samples)


def _curve(errors: dict[int, Array]) -> Array:
    curve = np.full(HIGHEST_ORDER, np.nan)
    for order, blocks in errors.items():
        if order <= HIGHEST_ORDER:
            curve[order - 1] = np.sqrt(blocks.mean())
    return curve


def _spectra(records: Sequence[Record], options: Options) -> ResponseEstimate:
    Ts_s = records[0].Ts_s
    segment_s = options.segment_s or _segment(records) * Ts_s
    usable = [r for r in records if len(r.y) * Ts_s >= 2 * segment_s]
    if not usable:
        longest_s = max(len(r.y) for r in records) * Ts_s
        raise IdentificationError(
            f"segment_s: expected two segments of {segment_s:g} s before the held-out "
            f"rows, found at most {longest_s:g} s; choose shorter segments"
        )
    grid = np.geomspace(1.0 / segment_s, 0.5 / Ts_s, BINS)
    return frequency_response([r.v for r in usable], [r.y for r in usable], Ts_s, grid, segment_s)


def _segment(records: Sequence[Record]) -> int:
    """Return the segment length in rows: an eighth of the longest record, or less.

    Two segments must fit into every record that is needed to excite all inputs.
    """
    ordered = sorted(records, key=lambda r: len(r.y), reverse=True)
    excited = np.logical_or.accumulate([r.excited for r in ordered])
    needed = ordered[
        int(np.argmax(excited.sum(axis=1)))
    ]  # the first with which all inputs are excited
    return min(len(ordered[0].y) // 8, len(needed.y) // 2)


def _hold_out(
    original: Record,
    record: Record,
    held: HeldOut,
    model: StateSpace | None,
    predictor: InnovationModel,
) -> HoldOut:
    """Run both models over the record, and compare them with the held-out rows."""
    start, rows = held.start, slice(held.start, held.stop)
    level = original.y[rows] - record.y[rows]
    known = [record.rows(0, start)]
    predicted = _predicted(predictor, known)(0, record)[rows] + level
    measured = original.y[rows]
    simulated = (
        np.full_like(measured, np.nan)
        if model is None
        else _simulated(model, known)(0, record)[rows] + level
    )
    time_s = np.arange(start, held.stop, dtype=np.float64) * record.Ts_s
    return HoldOut(
        record.name,
        time_s,
        measured,
        simulated,
        nrmse_fit_percent(measured, simulated),
        predicted,
        nrmse_fit_percent(measured, predicted),
    )
