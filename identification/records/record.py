"""What identification works on: records of excitation, plant input and output."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SAME_BEAM_M = 1e-3
"""Records whose mean beam positions are within so much belong to one operating point."""


class IdentificationError(Exception):
    """Records that cannot be identified; the message says which, what was expected and found."""


class NotARecordError(IdentificationError):
    """A log that is not to be identified, with the reason: part of a session, no failure."""


@dataclass(frozen=True)
class PiController:
    """The diagonal controller C(z) = Kp + Ki Ts z / (z - 1) of u = v - C y; kp and ki are (p,)."""

    kp: Array
    ki: Array

    def response(self, freq_hz: Array, Ts_s: float) -> NDArray[np.complex128]:
        """Return the diagonal of C as (F, p) at freq_hz (F,); it is infinite at 0 Hz."""
        z = np.exp(2j * np.pi * np.asarray(freq_hz) * Ts_s)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            integral = np.where(self.ki > 0, self.ki * Ts_s * z / (z - 1), 0.0)
        return np.asarray(self.kp + integral)


@dataclass(frozen=True)
class Record:
    """One experiment: excitation v (N, p), plant input u (N, p), output y (N, m).

    u is what was sent to the plant, behind all limits, without feed-forward; None where it is not
    known. `asked` (N, p) is what controller and excitation asked for, v - C y; None where it is u.
    `controller` is the one that closed the loop, None in open loop or when it is not known.
    `delay_cycles` are whole cycles between an input and its first action; None when not known (the
    output may then react in the cycle of its input). `at_rest` says that v = 0 before the first row
    and that y had settled to a constant. `remarks` say in words what happened during the record
    that a linear model does not know of. `input_units` are those of v and u.
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
    asked: Array | None = None
    beam_m: float | None = None
    controller: PiController | None = None
    delay_cycles: int | None = None
    at_rest: bool = False
    remarks: tuple[str, ...] = ()

    @property
    def leading_zeros(self) -> int:
        """Number of Markov parameters that are zero for certain: the hold and the whole cycles."""
        return 0 if self.delay_cycles is None else self.delay_cycles + 1

    @property
    def excited(self) -> NDArray[np.bool_]:
        """Inputs (p,) that carry any excitation."""
        return np.asarray(np.ptp(self.v, axis=0) > 0)

    def first_row(self, taps: int) -> int:
        """Return the first row whose past over `taps` samples is known."""
        return 0 if self.at_rest else taps - 1

    def rows(self, start: int, stop: int) -> Record:
        """Return the record cut to rows start..stop; at rest only if it still begins at row 0."""
        return replace(
            self,
            v=self.v[start:stop],
            y=self.y[start:stop],
            u=None if self.u is None else self.u[start:stop],
            asked=None if self.asked is None else self.asked[start:stop],
            at_rest=self.at_rest and start == 0,
        )


@dataclass(frozen=True)
class OperatingPoint:
    """Records of one beam position (m; None where there is no beam)."""

    beam_m: float | None
    records: tuple[Record, ...]


def operating_points(records: Sequence[Record]) -> tuple[OperatingPoint, ...]:
    """Group records by beam position (within 1 mm), in ascending order.

    Raises IdentificationError when there is no record, or when records of one position differ in
    sampling time, signals, controller or delay.
    """
    if not records:
        raise IdentificationError("expected at least one record to identify, found none")
    points = tuple(
        OperatingPoint(_mean_beam(group), tuple(group)) for group in by_position(records)
    )
    for point in points:
        _check_consistent(point)
    return points


class AtBeam(Protocol):
    """A record of any sort: `beam_m` is None where there is no beam."""

    @property
    def beam_m(self) -> float | None: ...  # noqa: D102


Some = TypeVar("Some", bound=AtBeam)


def by_position(records: Iterable[Some]) -> list[list[Some]]:
    """Return records in groups of one beam position, ascending; those of none come first.

    A group spans 1 mm from its first record on, however many lie a little further each.
    """
    groups: list[list[Some]] = []
    first: float | None = None
    for record in sorted(records, key=lambda r: -np.inf if r.beam_m is None else r.beam_m):
        here = record.beam_m
        near = here is None or (first is not None and here - first <= SAME_BEAM_M)
        if not groups or not near:
            groups.append([])
            first = here
        groups[-1].append(record)
    return groups


def describe_position(beam_m: float | None) -> str:
    """Return the position in words, for messages and labels."""
    return "no beam position" if beam_m is None else f"beam at {1e3 * beam_m:+.1f} mm"


def _mean_beam(group: list[Record]) -> float | None:
    beams = [r.beam_m for r in group if r.beam_m is not None]
    return float(np.mean(beams)) if beams else None


def _check_consistent(point: OperatingPoint) -> None:
    first = point.records[0]
    for record in point.records[1:]:
        for field in (
            *("Ts_s", "input_names", "input_units", "output_names", "output_units"),
            "delay_cycles",
        ):
            ours, theirs = getattr(first, field), getattr(record, field)
            if ours != theirs:
                raise IdentificationError(
                    f"{describe_position(point.beam_m)}: expected one {field} in all records, "
                    f"found {ours} in '{first.name}' and {theirs} in '{record.name}'"
                )
        if not _same_controller(first.controller, record.controller):
            raise IdentificationError(
                f"{describe_position(point.beam_m)}: expected one controller in all records, "
                f"found different gains in '{first.name}' and '{record.name}'"
            )


def _same_controller(a: PiController | None, b: PiController | None) -> bool:
    if a is None or b is None:
        return a is b
    return np.array_equal(a.kp, b.kp) and np.array_equal(a.ki, b.ki)
