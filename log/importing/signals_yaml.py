"""Describe the columns of a data file to import: the schema of SIGNALS.yaml."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal, Self, get_args

from pydantic import Field, field_validator, model_validator

from ...config.base import ConfigError, Finite, NonNegative, Positive, Strict, parse_text
from ...config.controller import ControllerConfig
from ...config.escaping import MOST_NAME
from ...config.rig import Name as FileName
from ...config.units import known_unit

Role = Literal["input", "output", "reference", "excitation", "scheduling", "time", "other"]
Format = Literal["csv", "text", "npz", "mat"]

# A name becomes a field of a ros2msg, a unit its comment in brackets: hence the patterns.
Name = Annotated[str, Field(max_length=MOST_NAME, pattern=r"^[a-z][a-z0-9]*(_[a-z0-9]+)*$")]
Unit = Annotated[str, Field(max_length=MOST_NAME, pattern=r"^[^\[\],#\s][^\[\],#\r\n\t]*$")]
Index = Annotated[int, Field(ge=0)]
MissingText = Annotated[str, Field(min_length=1)]


class Column(Strict):
    """One signal: its place in the file, name, unit and role in the model.

    `column` is a number, from 0, or a name: of the header in CSV and text, of a variable in NPZ and
    MAT (`struct.field` for a field of a MATLAB struct); `index` picks one column of a variable that
    is a matrix. A name may omit the unit in the header. The logged value is `scale` times the
    file's value plus `offset`, in `unit`.

    An excitation is added to the input `of`. For an output, `noise_sd` is the standard deviation of
    its white noise, and `resolution` its smallest step, both in `unit`; estimated if not given.

    `wraps`: the file's values begin again after this range, as an angle does after 360 degrees and
    a counter of 16 bit after 65536; `none` keeps such jumps. `outliers`: whether single values far
    from their neighbours are left out; if not given, only those that are certainly no readings.
    """

    column: Index | Annotated[str, Field(min_length=1)]
    index: Index | None = None
    name: Name
    unit: Unit
    role: Role
    scale: Finite = 1.0
    offset: Finite = 0.0
    of: Name | None = None
    noise_sd: Positive | None = None
    resolution: NonNegative | None = None
    wraps: Positive | Literal["none"] | None = None
    outliers: Literal["mask", "keep"] | None = None

    @field_validator("role", mode="before")
    @classmethod
    def _schedule(cls, value: object) -> object:
        return "scheduling" if value == "schedule" else value

    @model_validator(mode="after")
    def _keys_of_the_role(self) -> Self:
        if self.of is not None and self.role != "excitation":
            raise ValueError(f"of: expected with role excitation only, found role {self.role}")
        for key in ("noise_sd", "resolution"):
            if getattr(self, key) is not None and self.role != "output":
                raise ValueError(f"{key}: expected with role output only, found role {self.role}")
        return self

    @property
    def label(self) -> str:
        """The column's name in error messages."""
        index = "" if self.index is None else f", index {self.index}"
        return f"column {self.column!r}{index}"


class RowRange(Strict):
    """Range of samples to import, first and last included; row 0 follows the header."""

    first: Index = 0
    last: Index | None = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.last is not None and self.last < self.first:
            raise ValueError(f"expected last >= first, found {self.first} to {self.last}")
        return self

    @property
    def end(self) -> int | None:
        """The row after the last, None for the end of the file."""
        return None if self.last is None else self.last + 1


class Loop(Strict):
    """The control loop in which the data were measured; `unknown` if the law is not known."""

    controller: ControllerConfig | Literal["unknown"]

    @property
    def law(self) -> ControllerConfig | None:
        """The controller, None if it is unknown."""
        return None if self.controller == "unknown" else self.controller


class SignalsFile(Strict):
    """SIGNALS.yaml.

    The file's suffix or content gives `format` if it is not set. `decimal` and `thousands`: signs
    in the numbers of a text file, needed only where a number such as 1.234 has two meanings.
    `missing`: numbers or texts that mean that there is no value. `input_hold`: how the inputs
    behave between samples. `samples`: whether rows or columns of a matrix (NPZ, MAT) are samples. A
    column of role `time` gives the rate if `rate_hz` is not set; several such columns, as a date
    and a time of day or seconds and nanoseconds, are added. `resample`: interpolate irregular time
    stamps.
    `begins_s`: time of the first row since the session began; a trace searches drifts and
    vibrations in records of one session that do not overlap. `loop`: the control loop; without it
    the inputs do not depend on the outputs.
    """

    levid: Literal["signals"]
    name: FileName | None = None
    rate_hz: Positive | None = None
    resample: bool = False
    format: Format | None = None
    decimal: Literal[".", ","] | None = None
    thousands: Literal[".", ",", " ", "'"] | None = None
    missing: tuple[Finite | MissingText, ...] = ()
    rows: RowRange = RowRange()
    begins_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0
    samples: Literal["rows", "columns"] = "rows"
    input_hold: Literal["zoh", "foh", "band_limited"] = "zoh"
    columns: Annotated[tuple[Column, ...], Field(min_length=1)]
    loop: Loop | None = None

    @model_validator(mode="after")
    def _loop_of_known_signals(self) -> Self:
        by_role = {r: [c.name for c in self.with_role(r)] for r in get_args(Role)}
        for column in self.with_role("excitation"):
            inputs = by_role["input"]
            if column.of is None and len(inputs) > 1:
                raise ValueError(
                    f"{column.name}: of: expected one of the inputs {', '.join(inputs)}, found none"
                )
            if column.of is not None and column.of not in inputs:
                raise ValueError(
                    f"{column.name}: of: expected one of the inputs {', '.join(inputs)}, found "
                    f"{column.of}"
                )
        law = self.loop and self.loop.law
        if not law:
            return self
        pairs = [("input", law.drives), ("output", law.measured), ("reference", law.references)]
        if law.state_space is not None:
            others = [w for w in law.state_space.w if w not in by_role["output"]]
            pairs.append(("reference", tuple(others)))
        for role, names in pairs:
            for name in names:
                if name not in by_role[role]:
                    known = ", ".join(by_role[role]) or "none"
                    raise ValueError(
                        f"loop.controller: expected a column of role {role} (declared: {known}), "
                        f"found '{name}'"
                    )
        return self

    @model_validator(mode="after")
    def _different_signs(self) -> Self:
        if self.decimal is not None and self.decimal == self.thousands:
            raise ValueError(
                f"thousands: expected another sign than decimal, found '{self.thousands}' for both"
            )
        return self

    @model_validator(mode="after")
    def _distinct_names(self) -> Self:
        taken = {"time_s", "cycle"}
        for column in self.columns:
            if column.name in taken:
                raise ValueError(
                    f"expected names that differ from each other and from time_s and "
                    f"cycle, found '{column.name}' again"
                )
            taken.add(column.name)
        return self

    @model_validator(mode="after")
    def _rate_is_known(self) -> Self:
        times = self.with_role("time")
        if not times and self.rate_hz is None:
            raise ValueError("expected rate_hz or a column of role time, found neither")
        if not times and self.resample:
            raise ValueError("resample: expected a column of role time, found none")
        for column in times:
            unit = known_unit(column.unit)
            if unit is None or unit.si != "s":
                raise ValueError(
                    f"expected a unit of time for {column.name}, such as s, ms or us, found "
                    f"{column.unit}"
                )
        return self

    def with_role(self, role: Role) -> tuple[Column, ...]:
        """Return the columns of one role, in the order of the file."""
        return tuple(column for column in self.columns if column.role == role)


def attached_signals(attachments: Mapping[str, bytes]) -> SignalsFile | None:
    """Return the SIGNALS.yaml of an imported log; None without a valid one."""
    text = attachments.get("signals.yaml")
    if text is None:
        return None
    try:
        return parse_text(text, SignalsFile, "signals.yaml")
    except ConfigError:  # the identification reports it
        return None
