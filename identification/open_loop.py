"""Identify a system from input to output without a known controller, as for imported data."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..model.second_order import StateSpace
from .nonparametric.frequency_response import ResponseEstimate, frequency_response
from .nonparametric.markov_parameters import MarkovEstimate, estimate_markov, most_taps
from .options import Options
from .records.drop_short_records import drop_short_records, left_out_remarks
from .records.record import IdentificationError, OperatingPoint, Record
from .results import OpenLoopPoint
from .subspace.fit_percent import nrmse_fit_percent
from .subspace.held_out_simulation import HoldOut
from .subspace.ho_kalman import Scaling, decompose_coloured, realise
from .subspace.identify_innovation_model import choose_past, innovation_model, state_sequence
from .subspace.simulation import (
    InnovationModel,
    fit_input_matrices,
    initial_state,
    simulate,
    spectral_radius,
)

Array = NDArray[np.float64]

HIGHEST_ORDER = 20
PAST = (4, 6, 8, 10, 15, 20, 30, 40)
ROWS_A_TAP = 4
MOST_TAPS = 200
VALIDATION_SHARE = 0.25
BLOCKS = 8
"""Blocks in time from which the standard error of a validation error is estimated."""
BINS = 180
SETTLED = 1e-3
"""Least scale of an output's errors, over its rms in the whole record."""
_DIVERGED = 1e12
"""Relative squared error above which a model is rejected: its predictor diverges."""


@dataclass(frozen=True)
class _Candidates:
    """Models of every possible order from the same training records."""

    markov: MarkovEstimate
    singular_values: Array
    simulators: dict[int, StateSpace]
    predictors: dict[int, InnovationModel]


def identify_open_loop(
    point: OperatingPoint, options: Options, progress: Callable[[float], None]
) -> OpenLoopPoint:
    """Identify one operating point; `progress` is called with the share of the work done.

    The simulation model uses Markov parameters, Ho-Kalman weighted by the inputs, and refitted B
    and D; the predictor uses observer Markov parameters. Their orders are chosen by validation:
    models of every order are fitted to the first three quarters of the training rows and compared
    on the last. The held-out rows (`options.holdout`) only measure the fit.

    Raises IdentificationError for records that are too short, constant outputs, or if no stable
    model exists.
    """
    # The impulse response is at most half as long as the shortest record.
    records, too_short = drop_short_records(point.records, 2 * MOST_TAPS + 1)
    stops = [len(r.y) - options.holdout_rows(len(r.y)) for r in records]
    centred = [_centred(r, stop) for r, stop in zip(records, stops, strict=True)]
    training = [r.rows(0, stop) for r, stop in zip(centred, stops, strict=True)]
    part_stops = [stop - round(VALIDATION_SHARE * stop) for stop in stops]
    parts = [r.rows(0, stop) for r, stop in zip(training, part_stops, strict=True)]

    _check_outputs(parts)
    trial = _candidates(parts, options)
    progress(0.4)
    simulated = _errors(
        training, part_stops, {n: _simulated(m, parts) for n, m in trial.simulators.items()}
    )
    predicted = _errors(
        training, part_stops, {n: _predicted(m) for n, m in trial.predictors.items()}
    )
    final = _candidates(training, options)
    progress(0.8)
    cost = _state_cost(training)
    order = options.order or _smallest_good(simulated, final.simulators, cost)
    predictor_order = options.order or _smallest_good(predicted, final.predictors, cost)
    if order not in final.simulators or predictor_order not in final.predictors:
        raise IdentificationError(
            "order: expected the order of a stable model "
            f"({', '.join(map(str, final.simulators)) or 'no order gives one'}), found {order}"
        )
    model, predictor = final.simulators[order], final.predictors[predictor_order]
    spectra = _spectra(training, options)
    return OpenLoopPoint(
        beam_m=point.beam_m,
        records=tuple(r.name for r in records),
        markov={options.markov: final.markov},
        singular_values={options.markov: final.singular_values},
        order=order,
        predictor_order=predictor_order,
        validation_error=_curve(simulated),
        predictor_validation_error=_curve(predicted),
        model=model,
        predictor=predictor,
        freq_hz=spectra.freq_hz,
        from_ho_kalman=model.response(spectra.freq_hz),
        from_spectra=spectra,
        holdout=tuple(
            _hold_out(original, record, stop, model, predictor)
            for original, record, stop in zip(records, centred, stops, strict=True)
        ),
        remarks=(
            *(f"{r.name}: {text}" for r in records for text in r.remarks),
            *left_out_remarks(too_short),
        ),
    )


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


def _candidates(records: Sequence[Record], options: Options) -> _Candidates:
    Ts_s = records[0].Ts_s
    scaling = Scaling.of(records)
    markov = estimate_markov(records, _taps(records, options), options.markov)
    inputs = [r.v for r in records]
    decomposition = decompose_coloured(markov.g, Ts_s, scaling, inputs)
    sequence = state_sequence(choose_past(records, PAST), records, HIGHEST_ORDER)
    simulators, predictors = {}, {}
    failed: list[IdentificationError] = []
    for n in [options.order] if options.order else range(1, HIGHEST_ORDER + 1):
        if n <= decomposition.orders:
            model = realise(decomposition, n)
            if spectral_radius(model.A) < 1.0:
                simulators[n] = fit_input_matrices(model, records)
        if n <= len(sequence.singular_values):
            try:
                predictors[n] = innovation_model(sequence, n, Ts_s)
            except IdentificationError as error:
                failed.append(error)
    if failed and not predictors:
        raise failed[0]
    return _Candidates(markov, decomposition.singular_values, simulators, predictors)


def _taps(records: Sequence[Record], options: Options) -> int:
    if options.impulse_s is not None:
        return max(3, round(options.impulse_s / records[0].Ts_s))
    rows = sum(len(r.y) for r in records)
    shortest = min(len(r.y) for r in records)
    enough = min(rows // (ROWS_A_TAP * records[0].v.shape[1]), most_taps(records))
    return int(min(MOST_TAPS, enough, shortest // 2))


Run = Callable[[int, Record], Array]
"""Return a model's output for a record and its number; records may share a name."""


def _simulated(model: StateSpace, known: Sequence[Record]) -> Run:
    """Return a function that simulates a record; `known` rows determine the initial state."""
    starts = [initial_state(model, r.v, r.y) for r in known]
    return lambda number, record: simulate(model, record.v, starts[number])


def _predicted(model: InnovationModel) -> Run:
    predictor = model.predictor()
    return lambda _number, record: simulate(predictor, np.hstack([record.v, record.y]))


def _errors(
    records: Sequence[Record], starts: Sequence[int], runs: dict[int, Run]
) -> dict[int, Array]:
    """Return the squared error relative to the outputs' rms, by order, in BLOCKS blocks of time."""
    errors = {}
    for order, run in runs.items():
        blocks = np.zeros(BLOCKS)
        for number, (record, start) in enumerate(zip(records, starts, strict=True)):
            # The scale has a lower bound: an output may be at rest in the validation rows.
            size = np.maximum(record.y[start:].std(axis=0), SETTLED * record.y.std(axis=0))
            with np.errstate(over="ignore", invalid="ignore"):
                error = (record.y - run(number, record))[start:] / size
                blocks += [np.mean(part**2) for part in np.array_split(error, BLOCKS)]
        if np.all(blocks < _DIVERGED):  # also rejects nan
            errors[order] = blocks / len(records)
    return errors


def _smallest_good(
    errors: Mapping[int, Array], available: Collection[int], state_cost: float
) -> int:
    """Return the smallest order whose error is not significantly above the best order's.

    That is: the mean error is larger by at most one standard error of the difference, compared
    block by block, or its logarithm by at most `state_cost` for each state less.
    """
    possible = {n: e for n, e in errors.items() if n in available}
    if not possible:
        raise IdentificationError(
            "expected a stable model of at least one order, found none; record more data"
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
    original: Record, record: Record, start: int, model: StateSpace, predictor: InnovationModel
) -> HoldOut:
    """Run both models over the record, and compare them with the held-out rows from `start` on."""
    level = original.y[start:] - record.y[start:]
    simulated = _simulated(model, [record.rows(0, start)])(0, record)[start:] + level
    predicted = _predicted(predictor)(0, record)[start:] + level
    measured = original.y[start:]
    time_s = np.arange(start, len(record.y), dtype=np.float64) * record.Ts_s
    return HoldOut(
        record.name,
        time_s,
        measured,
        simulated,
        nrmse_fit_percent(measured, simulated),
        predicted,
        nrmse_fit_percent(measured, predicted),
    )
