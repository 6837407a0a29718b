"""Identify a plant from records: one model set for each operating point."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from .closed_loop import identify_closed_loop, wanted_rows
from .closed_loop_subspace import checked, subspace_plant
from .open_loop import identify_open_loop
from .options import Options
from .record_threads import record_threads
from .records.drop_short_records import drop_short_records, left_out_remarks
from .records.persistence_of_excitation import PoorExcitationError, check_inputs
from .records.record import (
    COMPARED_FIELDS,
    IdentificationError,
    OperatingPoint,
    Record,
    describe_position,
    operating_points,
)
from .records.signal_names import SignalNames
from .records.singular_equations import singular_equations
from .records.value_check import check_sizes
from .results import ClosedLoopPoint, IdentificationResult, OpenLoopPoint

Progress = Callable[[str, float], None]
"""Called with the current step and the share (0 to 1) of the work done."""


def identify(
    records: Sequence[Record],
    options: Options | None = None,
    progress: Progress | None = None,
    skipped: Sequence[str] = (),
) -> IdentificationResult:
    """Identify every operating point of the records.

    Records with a known controller are identified by the paper's method (closed_loop) and by the
    subspace method (closed_loop_subspace), others from input to output (open_loop). The result
    lists `skipped` (reasons for logs left out) and the reason for every position that failed.

    Raises IdentificationError, which names position and records: without records, for different
    signals or sampling times, and if all positions fail: an input without excitation, records too
    short, or poor excitation (PoorExcitationError if this is the reason at all positions).
    """
    options = options or Options()
    if not records:
        why = f" ({'; '.join(skipped)})" if skipped else ""
        raise IdentificationError(f"expected at least one record to identify, found none{why}")
    points = operating_points(records)
    first = points[0].records[0]
    for point in points:
        _check_same_signals(first, point.records[0])
    done = dict.fromkeys(range(len(points)), 0.0)

    def identified(number: int) -> ClosedLoopPoint | OpenLoopPoint | IdentificationError:
        point = points[number]

        def report_share(share: float) -> None:
            done[number] = share
            if progress is not None:
                progress(describe_position(point.beam_m), sum(done.values()) / len(points))

        report_share(0.0)
        method = identify_open_loop if first.controller is None else _identify_closed_loop_point
        try:
            with singular_equations("the black-box model"):
                check_inputs(point.records)
                for r in point.records:
                    check_sizes(r.name, r.v, r.y)
                return method(point, options, report_share)
        except IdentificationError as error:
            return error
        finally:
            report_share(1.0)

    with record_threads() as pool:
        found = list(pool.map(identified, range(len(points))))
    results = [x for x in found if not isinstance(x, IdentificationError)]
    errors = {
        describe_position(p.beam_m): x
        for p, x in zip(points, found, strict=True)
        if isinstance(x, IdentificationError)
    }
    reasons = [f"{where}: {error}" for where, error in errors.items()]
    if not results:
        poor = all(isinstance(error, PoorExcitationError) for error in errors.values())
        raise (PoorExcitationError if poor else IdentificationError)("; ".join(reasons))
    signals = SignalNames(
        first.input_names, first.input_units, first.output_names, first.output_units, first.Ts_s
    )
    return IdentificationResult(signals, tuple(results), (*skipped, *reasons))


def _identify_closed_loop_point(
    point: OperatingPoint, options: Options, progress: Callable[[float], None]
) -> ClosedLoopPoint:
    records, too_short = drop_short_records(
        point.records, wanted_rows(options, point.records[0].Ts_s)
    )
    plant, reasons = None, []
    try:
        plant = subspace_plant(records, options)
    except IdentificationError as error:
        reasons = [f"no subspace model: {error}"]
    progress(0.3)
    states = None if plant is None else plant.order
    found = identify_closed_loop(
        replace(point, records=records), options, lambda share: progress(0.3 + 0.7 * share), states
    )
    return replace(
        found,
        remarks=(*left_out_remarks(too_short), *found.remarks, *reasons),
        subspace=None if plant is None else checked(plant, found, records, options),
    )


def _check_same_signals(first: Record, other: Record) -> None:
    for field, name in COMPARED_FIELDS.items():
        ours, theirs = getattr(first, field), getattr(other, field)
        if ours != theirs:
            raise IdentificationError(
                f"expected one {name} in all records, found {ours} in '{first.name}' and {theirs} "
                f"in '{other.name}'; identify them separately"
            )
    if (first.controller is None) != (other.controller is None):
        raise IdentificationError(
            f"expected a known controller in all records or in none, found one in only one of "
            f"'{first.name}' and '{other.name}'; identify them separately"
        )
