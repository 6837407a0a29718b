"""From records to models: every operating point by what its records allow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from threadpoolctl import threadpool_limits

from .closed_loop import identify_closed_loop, wanted_rows
from .closed_loop_subspace import with_subspace
from .open_loop import identify_open_loop
from .options import Options
from .records.persistence_of_excitation import PoorExcitationError, check_inputs
from .records.record import (
    IdentificationError,
    OperatingPoint,
    Record,
    describe_position,
    operating_points,
)
from .records.record_length import left_out_remarks, long_enough
from .records.signal_names import SignalNames
from .results import ClosedLoopPoint, IdentificationResult, OpenLoopPoint

Progress = Callable[[str, float], None]
"""Is told what is being done, and the share (0 to 1) of all work that is done."""


def identify(
    records: Sequence[Record],
    options: Options | None = None,
    progress: Progress | None = None,
    skipped: Sequence[str] = (),
) -> IdentificationResult:
    """Identify every operating point that the records cover.

    Records under a known controller are treated as the paper does (closed_loop) and by the subspace
    method (closed_loop_subspace), others as plain input and output (open_loop). `skipped` (reasons
    for logs left out) goes into the result, with the reason for every position whose records do not
    do, as long as another one's do.

    Raises IdentificationError, which names position and records: no records, signals or sampling
    that differ; and where no position is left, an input that none excites, records too short or too
    poor (PoorExcitationError if it is the excitation alone, at all of them).
    """
    options = options or Options()
    if not records:
        why = f" ({'; '.join(skipped)})" if skipped else ""
        raise IdentificationError(f"expected at least one record to identify, found none{why}")
    points = operating_points(records)
    first = points[0].records[0]
    for point in points:
        _check_same_signals(first, point.records[0])
    results: list[ClosedLoopPoint | OpenLoopPoint] = []
    failed: dict[str, IdentificationError] = {}
    for number, point in enumerate(points):
        where = describe_position(point.beam_m)

        def told(share: float, number: int = number, where: str = where) -> None:
            if progress is not None:
                progress(where, (number + share) / len(points))

        told(0.0)
        method = identify_open_loop if first.controller is None else _in_its_loop
        try:
            # The matrices are small: threads of the BLAS would wait for each other, not compute.
            with threadpool_limits(1):
                check_inputs(point.records)
                results.append(method(point, options, told))
        except IdentificationError as error:
            failed[where] = error
        told(1.0)
    reasons = [f"{where}: {error}" for where, error in failed.items()]
    if not results:
        poor = all(isinstance(error, PoorExcitationError) for error in failed.values())
        raise (PoorExcitationError if poor else IdentificationError)("; ".join(reasons))
    signals = SignalNames(
        first.input_names, first.input_units, first.output_names, first.output_units, first.Ts_s
    )
    return IdentificationResult(signals, tuple(results), (*skipped, *reasons))


def _in_its_loop(
    point: OperatingPoint, options: Options, progress: Callable[[float], None]
) -> ClosedLoopPoint:
    records, too_short = long_enough(point.records, wanted_rows(options, point.records[0].Ts_s))
    found = identify_closed_loop(replace(point, records=records), options, progress)
    told = replace(found, remarks=(*left_out_remarks(too_short), *found.remarks))
    return with_subspace(told, records, options)


def _check_same_signals(first: Record, other: Record) -> None:
    for field in ("Ts_s", "input_names", "output_names", "input_units", "output_units"):
        ours, theirs = getattr(first, field), getattr(other, field)
        if ours != theirs:
            raise IdentificationError(
                f"expected one {field} in all records, found {ours} in '{first.name}' and {theirs} "
                f"in '{other.name}'; identify them apart"
            )
    if (first.controller is None) != (other.controller is None):
        raise IdentificationError(
            f"expected records of one kind, found '{first.name}' and '{other.name}', of which only "
            "one has a known controller; identify them apart"
        )
