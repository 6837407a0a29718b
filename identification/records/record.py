"""Hold one experiment's excitation, plant input and output, and group records by beam position."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from .varying_signals import varying

Array = NDArray[np.float64]

BEAM_POSITION_TOLERANCE_M = 1e-3
"""Records within this distance of beam position belong to one operating point."""


class IdentificationError(Exception):
    """Records that cannot be identified; the message names them, the expected and the found."""


class NotARecordError(IdentificationError):
    """A log to skip, with the reason: another step of a session, for example. Not a failure."""


OTHER_STEP = "not a record of the session"
"""Text in the note on a log of another session step, which summaries leave out."""


@dataclass(frozen=True)
class PiController:
    """The diagonal controller C(z) = Kp + Ki Ts z / (z - 1) of u = v - C y; kp and ki are (p,)."""

    kp: Array
    ki: Array

    def response(self, freq_hz: Array, Ts_s: float) -> NDArray[np.complex128]:
        """Return the diagonal of C (F, p) at freq_hz (F,); it is infinite at 0 Hz."""
        z = np.exp(2j * np.pi * np.asarray(freq_hz) * Ts_s)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            integral = np.where(self.ki > 0, self.ki * Ts_s * z / (z - 1), 0.0)
        return np.asarray(self.kp + integral)


@dataclass(frozen=True)
class Record:
    """One experiment: excitation v (N, p), plant input u (N, p), output y (N, m).

    `u` is the plant input after all limits, without feed-forward; None if unknown.
    `u_unlimited` (N, p) is the plant input before the limits, v - C y; None if it equals u.
    `controller` is the controller of the loop; None in open loop or if unknown.
    `delay_cycles` is the number of whole cycles between an input and its first effect; None if
    unknown (the output may then react in the cycle of its input). `feedback`: the input depends on
    the output, by an unknown controller unless `controller` is given. `held`: the input rests
    between rows. `at_rest`: v = 0 before the
    first row, and y had settled to a constant. `remarks` describe events in the record that a
    linear model does not include. `input_units` are the units of v and u.
    """

    name: str
    Ts_s: float
    v: Array
    y: Array
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    u: Array | None = None
    u_unlimited: Array | None = None
    beam_m: float | None = None
    controller: PiController | None = None
    delay_cycles: int | None = None
    feedback: bool = False
    held: bool = False
    at_rest: bool = False
    remarks: tuple[str, ...] = ()

    @property
    def leading_zeros(self) -> int:
        """Number of Markov parameters that the hold and the delay make zero."""
        return 0 if self.delay_cycles is None else self.delay_cycles + 1

    @property
    def direct(self) -> bool:
        """Whether an output may depend on the input of its own row.

        In a loop the input of a row may depend on that row's output, and a held input acts after
        it: a direct term would take the controller for the plant, and bias all others.
        """
        return not (self.feedback and self.held)

    @property
    def excited(self) -> NDArray[np.bool_]:
        """Which inputs (p,) are excited."""
        return varying(self.v)

    def first_row(self, taps: int) -> int:
        """Return the first row whose last `taps` samples are known."""
        return 0 if self.at_rest else taps - 1

    def rows(self, start: int, stop: int) -> Record:
        """Return rows start to stop (exclusive); at_rest only if they begin at row 0."""
        return replace(
            self,
            v=self.v[start:stop],
            y=self.y[start:stop],
            u=None if self.u is None else self.u[start:stop],
            u_unlimited=None if self.u_unlimited is None else self.u_unlimited[start:stop],
            at_rest=self.at_rest and start == 0,
        )


@dataclass(frozen=True)
class OperatingPoint:
    """Records of one beam position in m; None without a beam."""

    beam_m: float | None
    records: tuple[Record, ...]


def operating_points(records: Sequence[Record]) -> tuple[OperatingPoint, ...]:
    """Group records by beam position (within 1 mm), in ascending order.

    Raises IdentificationError without records, or if records of one position differ in sampling
    time, signals, controller or delay.
    """
    if not records:
        raise IdentificationError("expected at least one record to identify, found none")
    points = tuple(
        OperatingPoint(_mean_beam(group), tuple(group)) for group in by_position(records)
    )
    for point in points:
        _check_consistent(point)
    return points


class HasBeamPosition(Protocol):
    """A record with a mean beam position; `beam_m` is None without a beam."""

    @property
    def beam_m(self) -> float | None: ...  # noqa: D102


RecordT = TypeVar("RecordT", bound=HasBeamPosition)


def by_position(records: Iterable[RecordT]) -> list[list[RecordT]]:
    """Group records by beam position, ascending; records without a beam come first.

    A group spans at most 1 mm from its first record.
    """
    groups: list[list[RecordT]] = []
    first: float | None = None
    for record in sorted(records, key=lambda r: -np.inf if r.beam_m is None else r.beam_m):
        here = record.beam_m
        near = here is None or (first is not None and here - first <= BEAM_POSITION_TOLERANCE_M)
        if not groups or not near:
            groups.append([])
            first = here
        groups[-1].append(record)
    return groups


def describe_position(beam_m: float | None) -> str:
    """Return the beam position as text for messages and labels."""
    return "no beam position" if beam_m is None else f"beam at {1e3 * beam_m:+.1f} mm"


def _mean_beam(group: list[Record]) -> float | None:
    beams = [r.beam_m for r in group if r.beam_m is not None]
    return float(np.mean(beams)) if beams else None


COMPARED_FIELDS = {
    "Ts_s": "sampling time in s",
    "input_names": "set of inputs",
    "input_units": "set of input units",
    "output_names": "set of outputs",
    "output_units": "set of output units",
    "feedback": "statement on a loop",
}
"""Fields that must agree in all records, with their names in messages."""


def _written(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _check_consistent(point: OperatingPoint) -> None:
    first = point.records[0]
    where = "" if point.beam_m is None else f"{describe_position(point.beam_m)}: "
    for record in point.records[1:]:
        for field, name in (*COMPARED_FIELDS.items(), ("delay_cycles", "delay in cycles")):
            ours, theirs = getattr(first, field), getattr(record, field)
            if ours != theirs:
                raise IdentificationError(
                    f"{where}expected one {name} in all records, found {_written(ours)} in "
                    f"'{first.name}' and {_written(theirs)} in '{record.name}'; identify them "
                    "separately"
                )
        if not _same_controller(first.controller, record.controller):
            raise IdentificationError(
                f"{where}expected one controller in all records, found different gains in "
                f"'{first.name}' and '{record.name}'; identify them separately"
            )


def _same_controller(a: PiController | None, b: PiController | None) -> bool:
    if a is None or b is None:
        return a is b
    return np.array_equal(a.kp, b.kp) and np.array_equal(a.ki, b.ki)
