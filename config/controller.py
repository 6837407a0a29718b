"""Schema of a sampled controller: PID loops, cascades of them, or state-space matrices."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from .base import Finite, NonNegative, Positive, Strict
from .error_messages import quoted

Signal = Annotated[str, Field(pattern=r"^[a-z][a-z0-9]*(_[a-z0-9]+)*$")]
MOST_STATES = 64
Rows = Annotated[tuple[tuple[Finite, ...], ...], Field(max_length=MOST_STATES)]


class PidLoop(Strict):
    """One loop: e = reference - measured, out = PID(e), sampled once a row.

    `form`: parallel kp + ki/s + kd s; ideal kp (1 + 1/(ti s) + td s); series
    kp (1 + 1/(ti s)) (1 + td s). The integral is the backward sum, the derivative the backward
    difference, with a first-order filter of `derivative_filter_s`. A negative kp acts the other way
    round.

    `measured` is an output; `rate: true` takes its backward difference per second instead, and
    `average` the mean of its last samples before that. `reference` is a column or a constant. It is
    absent in the inner loops of a cascade, whose reference is the outer loop's output.
    """

    measured: Signal
    reference: Signal | Finite | None = None
    rate: bool = False
    average: Annotated[int, Field(ge=1, le=MOST_STATES)] = 1
    form: Literal["parallel", "ideal", "series"] = "parallel"
    kp: Finite
    ki: Finite = 0.0
    kd: Finite = 0.0
    ti_s: Positive | None = None
    td_s: NonNegative = 0.0
    derivative_filter_s: NonNegative = 0.0
    derivative_of: Literal["error", "measured"] = "error"

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        parallel, times = self.ki or self.kd, self.ti_s or self.td_s
        if self.form == "parallel" and times:
            raise ValueError(
                "expected ki and kd with form parallel, found ti_s or td_s of form ideal or series"
            )
        if self.form != "parallel" and parallel:
            raise ValueError(f"expected ti_s and td_s with form {self.form}, found ki or kd")
        return self

    @property
    def gains(self) -> tuple[float, float, float]:
        """Proportional, integral and derivative gain of the parallel form."""
        if self.form == "parallel":
            return self.kp, self.ki, self.kd
        rest = 0.0 if self.ti_s is None else 1.0 / self.ti_s
        shared = self.kp * (1.0 + (self.td_s * rest if self.form == "series" else 0.0))
        return shared, self.kp * rest, self.kp * self.td_s


class PidLaw(Strict):
    """The law of one input: loops from outer to inner; one loop is a plain PID controller.

    `limits` clip the output. `tracking_s`: time constant with which the innermost integral follows
    a clipped output (back-calculation); without it the integral winds up. `actuator_gain` and
    `actuator_lag_s` are the gain and the first-order lag from the controller's output to the
    recorded input, for example 1/R and L/R from a voltage to a recorded current.
    """

    loops: Annotated[tuple[PidLoop, ...], Field(min_length=1, max_length=8)]
    limits: tuple[Finite, Finite] | None = None
    tracking_s: Positive | None = None
    actuator_gain: Finite = 1.0
    actuator_lag_s: NonNegative = 0.0

    @model_validator(mode="after")
    def _chained(self) -> Self:
        for loop in self.loops[1:]:
            if loop.reference is not None:
                raise ValueError(
                    "loops: expected a reference in the first loop only, found one in an inner "
                    "loop, whose reference is the output of the loop before it"
                )
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            raise ValueError(
                f"limits: expected [low, high] with low < high, found {quoted(self.limits)}"
            )
        if self.tracking_s is not None and (self.limits is None or self.loops[-1].gains[1] == 0.0):
            raise ValueError(
                "tracking_s: expected limits, and an integral in the last loop, found none"
            )
        if self.actuator_lag_s and self.limits is not None:
            raise ValueError(
                "actuator_lag_s: expected no limits with a lag, found limits, which act before "
                "the lag"
            )
        return self


class StateSpaceLaw(Strict):
    """x(k+1) = A x + B w, u = C x + D w, clipped to `limits`, [low, high] of each driven input.

    `w` names references and outputs in the order of the columns of B and D, `drives` the inputs.
    """

    drives: Annotated[tuple[Signal, ...], Field(min_length=1, max_length=MOST_STATES)]
    w: Annotated[tuple[Signal, ...], Field(min_length=1, max_length=MOST_STATES)]
    A: Rows = ()
    B: Rows = ()
    C: Rows = ()
    D: Rows
    limits: tuple[tuple[Finite, Finite], ...] | None = None

    @model_validator(mode="after")
    def _shapes(self) -> Self:
        n, p, m = len(self.A), len(self.drives), len(self.w)
        expected = {"A": (n, n), "B": (n, m), "C": (p if n else 0, n), "D": (p, m)}
        for name, (rows, columns) in expected.items():
            matrix = getattr(self, name)
            if len(matrix) != rows or any(len(row) != columns for row in matrix):
                widths = sorted({len(row) for row in matrix}) or [0]
                raise ValueError(
                    f"{name}: expected {rows} rows of {columns} numbers ({n} states, {p} inputs "
                    f"driven, {m} signals in w), found {len(matrix)} rows of "
                    f"{' or '.join(map(str, widths))}"
                )
        if self.limits is not None and len(self.limits) != p:
            raise ValueError(f"limits: expected {p} pairs [low, high], found {len(self.limits)}")
        return self


class ControllerConfig(Strict):
    """A controller: PID laws by the input that they drive, or one state-space law.

    `delay_rows`: rows from a measurement to the first command that uses it; 0 if the command in a
    row is computed from the outputs of that row.
    """

    pid: dict[Signal, PidLaw] = Field(default_factory=dict)
    state_space: StateSpaceLaw | None = None
    delay_rows: Annotated[int, Field(ge=0, le=8)] = 0

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if bool(self.pid) == (self.state_space is not None):
            raise ValueError(
                f"expected either pid or state_space, found {'both' if self.pid else 'neither'}"
            )
        return self

    @property
    def drives(self) -> tuple[str, ...]:
        """The inputs that the controller drives."""
        return tuple(self.pid) if self.state_space is None else self.state_space.drives

    @property
    def measured(self) -> tuple[str, ...]:
        """The signals that must be outputs."""
        return tuple(loop.measured for law in self.pid.values() for loop in law.loops)

    @property
    def references(self) -> tuple[str, ...]:
        """The columns that serve as references of PID loops."""
        found = (law.loops[0].reference for law in self.pid.values())
        return tuple(name for name in found if isinstance(name, str))
