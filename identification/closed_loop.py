"""Identify one operating point with a known controller: the paper's section 4."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from .loop_spectra.spectral_lines import HIGHEST_SHARE
from .nonparametric import frequency_response
from .nonparametric.markov_parameters import (
    ESTIMATORS,
    MarkovEstimate,
    estimate_markov,
    markov_response,
    most_taps,
)
from .options import LOOP_IMPULSE_S, LOOP_SEGMENT_S, Options
from .record_threads import record_threads
from .records.persistence_of_excitation import PoorExcitationError, check_excitation
from .records.record import OperatingPoint, Record
from .results import ClosedLoopPoint
from .subspace.delay_removal import change_without_delay, without_delay
from .subspace.held_out_simulation import hold_out, settled_row
from .subspace.ho_kalman import Decomposition, Scaling, decompose, noise_level, realise
from .subspace.model_checks import (
    LONGEST_SETTLING_S,
    SETTLED_S,
    STATES_A_DOF,
    VISIBLE_TRUNCATION,
    has_decayed,
    plant_doubts,
    predicted_errors,
    settling_time,
)
from .subspace.plant_from_loop import IdentifiedPlant, closed_loop, plant_from_loop

Array = NDArray[np.float64]

LOWEST_HZ, PER_DECADE = 0.5, 67
"""The logarithmic frequency grid of responses, up to a share of the sampling rate; a segment of
10 s resolves the lowest well."""
LEAST_RESPONSES = 3
"""Least ratio of the shortest record's training rows to the impulse response."""
LEAST_SEGMENTS = 4
"""Least ratio of the shortest record's settled rows to a segment of the spectra."""
LENGTHEN = 1.5


def identify_closed_loop(
    point: OperatingPoint,
    options: Options,
    progress: Callable[[float], None],
    states: int | None = None,
) -> ClosedLoopPoint:
    """Identify one operating point; `progress` is called with the share of the work done.

    states: the plant's number of states where another method has found it; None: as many as show
    in the singular values above the errors of the Markov parameters.

    The end of every record (`options.holdout`) is held out and simulated with the identified loop.
    The spectra use all settled rows. `doubts` of the result lists reasons not to use the model.

    Raises PoorExcitationError if the excitation does not determine the Markov parameters, and the
    IdentificationErrors of its steps.
    """
    controller = point.records[0].controller
    assert controller is not None
    Ts_s = point.records[0].Ts_s
    delay = point.records[0].leading_zeros
    lag_pole = options.lag_pole(Ts_s)
    training = [r.rows(0, len(r.y) - options.holdout_rows(len(r.y))) for r in point.records]
    scaling = Scaling.of(training)
    ladder = _lengths(options, training)
    check_excitation(training, ladder[0])
    first = _decayed(training, ladder, options)
    length = len(first.g)

    def evidence(method: str) -> tuple[MarkovEstimate, Decomposition, float]:
        own = first if method == options.markov else estimate_markov(training, length, method)
        known = own.g, delay, lag_pole, controller, Ts_s
        decomposition = decompose(without_delay(*known), Ts_s, scaling)
        return (
            own,
            decomposition,
            noise_level(own, training, change_without_delay(*known), scaling),
        )

    methods = sorted(ESTIMATORS, key=lambda m: m != options.markov)
    with record_threads() as pool:
        found = dict(zip(methods, pool.map(evidence, methods), strict=True))
    progress(0.7)
    markov = {method: own for method, (own, _, _) in found.items()}
    decompositions = {method: d for method, (_, d, _) in found.items()}
    levels = {method: level for method, (_, _, level) in found.items()}
    decomposition = decompositions[options.markov]
    shown = int(np.sum(decomposition.singular_values > levels[options.markov]))
    wanted = shown if states is None else states + int(np.sum(controller.ki > 0))
    # A lower bound on the order: otherwise slow integrators are sometimes taken for noise.
    least = STATES_A_DOF * len(controller.ki) + int(np.sum(controller.ki > 0))
    order = options.order or min(max(min(shown, wanted), least), decomposition.orders)
    loop = realise(decomposition, order)
    plant = IdentifiedPlant(plant_from_loop(loop, controller), delay, lag_pole)
    full_loop = closed_loop(plant.state_space(), controller)
    settled_s = settling_time(full_loop, SETTLED_S, LONGEST_SETTLING_S)
    starts = [settled_row(r, settled_s) for r in point.records]
    settled = [r.rows(row, len(r.y)) for r, row in zip(point.records, starts, strict=True)]
    segment_s = options.segment_s or _at_most(LOOP_SEGMENT_S, settled, LEAST_SEGMENTS)

    highest_hz = HIGHEST_SHARE / Ts_s
    points = max(round(PER_DECADE * np.log10(highest_hz / LOWEST_HZ)), 2)
    grid = np.geomspace(LOWEST_HZ, highest_hz, points)
    S = frequency_response.sensitivity(settled, grid, segment_s)
    joint = frequency_response.plant_from_joint(settled, grid, segment_s)
    free = [i for i in range(len(controller.kp)) if not (controller.kp[i] or controller.ki[i])]
    G = frequency_response.frequency_response(
        [r.v for r in settled], [r.y for r in settled], Ts_s, grid, segment_s
    )
    progress(0.9)
    measured = markov_response(markov[options.markov].g, S.freq_hz, Ts_s)
    holdout = tuple(
        hold_out(r, full_loop, options.holdout_rows(len(r.y)), row)
        for r, row in zip(point.records, starts, strict=True)
    )
    return ClosedLoopPoint(
        beam_m=point.beam_m,
        records=tuple(r.name for r in point.records),
        controller=controller,
        markov=markov,
        singular_values={m: d.singular_values for m, d in decompositions.items()},
        noise_levels=levels,
        order=order,
        loop=loop,
        plant=plant,
        freq_hz=S.freq_hz,
        from_ho_kalman=plant.response(S.freq_hz),
        from_markov=frequency_response.plant_from_loop_response(
            measured, controller, S.freq_hz, Ts_s
        ),
        from_sensitivity=joint
        if free
        else frequency_response.plant_from_sensitivity(S, controller),
        from_joint=joint,
        sensitivity=S,
        loop_coherence=G.coherence,
        holdout=holdout,
        remarks=(
            *(f"{r.name}: {text}" for r in point.records for text in r.remarks),
            *_length_remarks(options, first, ladder[-1], segment_s),
            *_settling_remarks(settled_s, starts, Ts_s),
            *_feedback_remarks([point.records[0].output_names[i] for i in free]),
        ),
        doubts=(
            *(_order_doubts(order, wanted, shown) if options.order is None else ()),
            *plant_doubts(
                plant, full_loop, holdout, predicted_errors(point.records, holdout, first)
            ),
        ),
    )


def wanted_rows(options: Options, Ts_s: float) -> int:
    """Return the length in rows that a record needs for full impulse response and segments."""
    impulse_s = LEAST_RESPONSES * (options.impulse_s or LOOP_IMPULSE_S) / (1.0 - options.holdout)
    segments_s = LEAST_SEGMENTS * (options.segment_s or LOOP_SEGMENT_S)
    return round(max(impulse_s, segments_s) / Ts_s)


def _lengths(options: Options, training: Sequence[Record]) -> list[int]:
    """Return the numbers of taps to try, ascending.

    The maximum is a third of the shortest record, and what the rows of all records determine: one
    record that excites three inputs has to be longer than three that excite one each.
    """
    Ts_s = training[0].Ts_s
    if options.impulse_s is not None:
        return [round(options.impulse_s / Ts_s)]
    longest = min(min(len(r.y) for r in training) // LEAST_RESPONSES, most_taps(training))
    out = [min(round(LOOP_IMPULSE_S / Ts_s), longest)]
    while out[-1] < longest:
        out.append(min(round(LENGTHEN * out[-1]), longest))
    return out


def _decayed(training: Sequence[Record], ladder: Sequence[int], options: Options) -> MarkovEstimate:
    """Return the shortest estimate that has decayed at its end, else the longest possible one."""
    found = estimate_markov(training, ladder[0], options.markov)
    for length in ladder[1:]:
        if has_decayed(found):
            break
        try:
            check_excitation(training, length)
        except PoorExcitationError:
            break
        found = estimate_markov(training, length, options.markov)
    return found


def _order_doubts(order: int, wanted: int, shown: int) -> tuple[str, ...]:
    if shown >= order >= wanted:
        return ()
    return (
        f"the singular values of the impulse response show {shown} states above its noise; the "
        f"loop has {max(order, wanted)}",
    )


def _at_most(wanted_s: float, records: Sequence[Record], share: int) -> float:
    """Return `wanted_s`, limited to 1 / `share` of the shortest record."""
    return min(wanted_s, min(len(r.y) for r in records) // share * records[0].Ts_s)


def _length_remarks(
    options: Options, markov: MarkovEstimate, longest: int, segment_s: float
) -> list[str]:
    remarks = []
    impulse_s = len(markov.g) * markov.Ts_s
    if options.impulse_s is None and len(markov.g) < round(LOOP_IMPULSE_S / markov.Ts_s):
        remarks.append(f"short records: the impulse response is limited to {impulse_s:.3g} s")
    elif options.impulse_s is None and impulse_s > LOOP_IMPULSE_S + markov.Ts_s:
        remarks.append(
            f"the loop rings for more than {LOOP_IMPULSE_S:g} s: the impulse response has "
            f"{impulse_s:.3g} s"
        )
        if not has_decayed(markov, VISIBLE_TRUNCATION):
            limit = "record length" if len(markov.g) == longest else "excitation"
            remarks.append(
                f"the impulse response has not decayed after {impulse_s:.3g} s, the limit by the "
                f"{limit}: make longer records"
            )
    if options.segment_s is None and segment_s < LOOP_SEGMENT_S:
        remarks.append(f"short records: the spectra resolve only {1 / segment_s:.2g} Hz")
    return remarks


def _settling_remarks(settled_s: float, starts: Sequence[int], Ts_s: float) -> list[str]:
    if settled_s <= SETTLED_S:
        return []
    remark = f"the loop rings for {settled_s:.3g} s, which are left out at the start of records"
    left_out_s = [start * Ts_s for start in starts if start]
    if left_out_s and min(left_out_s) < settled_s - Ts_s:
        remark += f"; of the shortest only {min(left_out_s):.3g} s, a quarter of it"
    return [remark] if left_out_s else []


def _feedback_remarks(without: Sequence[str]) -> list[str]:
    if not without:
        return []
    return [
        f"no feedback from {', '.join(without)}, so (15) cannot be used: the joint estimate "
        "replaces it"
    ]
