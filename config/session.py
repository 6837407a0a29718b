"""Schema of SESSION.yaml: lift-off, beam moves, records with excitation, landing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from .base import Finite, NonNegative, Positive, Strict, load_yaml
from .error_messages import quoted
from .rig import Name, Rate

MOST_STEPS = 1000
"""Largest number of steps in a session."""
Duration = Annotated[float, Field(gt=0, le=86_400, allow_inf_nan=False)]
Pause = Annotated[float, Field(ge=0, le=86_400, allow_inf_nan=False)]
# The drive counts 1e-7 rad in 32 bits; a larger angle cannot be commanded.
RotorAngle = Annotated[float, Field(ge=-214.7, le=214.7, allow_inf_nan=False)]
Dof = Literal["psi", "theta", "z"]


class Excitation(Strict):
    """An excitation signal at one input: psi, theta, z, or one coil by its number.

    The level is `rms_n_m` for a torque (psi, theta), else `rms_n`. `band_hz` limits the spectrum;
    without it white noise extends to half the rate. In a record of more than 1,048,576 cycles,
    noise in a band consists of independent pieces of that length. A multisine has the period
    `period_s`; its `lines` are multiples of 1 / period_s in the band: all, odd ones, or odd ones
    with a random one of every four left out (`odd_random_grid`). The response at unexcited lines
    measures nonlinear distortion. All lines have the same amplitude; above `rise_hz` it grows in
    proportion to frequency, because a mass responds less there.
    """

    input: Dof | Annotated[str, Field(pattern=r"^coil:\d+$")]
    signal: Literal["white_noise", "multisine"] = "white_noise"
    rms_n_m: Positive | None = None
    rms_n: Positive | None = None
    band_hz: tuple[NonNegative, Positive] | None = None
    period_s: Duration | None = None
    lines: Literal["all", "odd", "odd_random_grid"] = "all"
    rise_hz: Positive | None = None

    @model_validator(mode="after")
    def _fits(self) -> Self:
        torque = self.input in ("psi", "theta")
        need, other = ("rms_n_m", "rms_n") if torque else ("rms_n", "rms_n_m")
        if getattr(self, need) is None or getattr(self, other) is not None:
            given = [key for key in (need, other) if getattr(self, key) is not None]
            raise ValueError(
                f"expected the key '{need}' for the level of input '{self.input}', found "
                f"{' and '.join(given) or 'none'}"
            )
        if self.band_hz is not None and self.band_hz[0] >= self.band_hz[1]:
            raise ValueError(
                f"band_hz: expected [low, high] with low < high, found {quoted(self.band_hz)}"
            )
        if (self.signal == "multisine") != (self.period_s is not None):
            found = "none" if self.period_s is None else f"it with signal {self.signal}"
            raise ValueError(f"period_s: expected with signal multisine only, found {found}")
        if self.signal == "multisine" and self.band_hz is None:
            raise ValueError("band_hz: expected with signal multisine, found none")
        if self.signal != "multisine" and self.lines != "all":
            raise ValueError(f"lines: expected with signal multisine only, found {self.lines}")
        if self.signal != "multisine" and self.rise_hz is not None:
            raise ValueError(
                f"rise_hz: expected with signal multisine only, found {self.rise_hz:g}"
            )
        return self

    @property
    def level(self) -> float:
        """RMS level in N m (psi, theta) or N."""
        level = self.rms_n_m if self.rms_n_m is not None else self.rms_n
        assert level is not None
        return level


class Waypoint(Strict):
    """Move the beam to `to_m` on a smooth profile within the limits, then stay for `dwell_s`."""

    to_m: Finite
    velocity_m_s: Positive | None = None
    acceleration_m_s2: Positive | None = None
    dwell_s: Pause = 0.0


class RotorWaypoint(Strict):
    """Turn the rotor to `to_rad` on a smooth profile within the limits, then stay for `dwell_s`."""

    to_rad: RotorAngle
    velocity_rad_s: Positive | None = None
    acceleration_rad_s2: Positive | None = None
    dwell_s: Pause = 0.0


class CoilCheck(Strict):
    """Coil check after lift-off: each coil in turn pushes up, down twice, up."""

    push_n: Annotated[float, Field(gt=0, le=10.0)] = 1.0
    push_s: Annotated[float, Field(gt=0, le=0.1)] = 0.008
    pause_s: Annotated[float, Field(gt=0, le=5.0)] = 0.05


class Levitate(Strict):
    """Take the weight off the stops in `unload_s`, rise in `ramp_s`, settle for `settle_s`.

    With `check_coils` each coil is pushed before the platform settles; if a coil responds unlike
    the others, the fault is COIL_CHECK. By default the daemon checks the coils at the first
    lift-off after its start and after each `levid clear`.
    """

    unload_s: Duration = 0.5
    ramp_s: Duration = 1.5
    check_coils: CoilCheck | Literal[False] | None = None
    settle_s: Pause = 4.0


class Move(Strict):
    """Move beam, rotor or both, then settle for `settle_s`."""

    beam_m: Finite | None = None
    rotor_rad: RotorAngle | None = None
    velocity_m_s: Positive | None = None
    acceleration_m_s2: Positive | None = None
    settle_s: Pause = 4.0


class Orthogonal(Strict):
    """Orthogonal multisines: simultaneous excitation of several inputs.

    Each realisation draws new random phases and consists of as many experiments as there are
    multisines; between experiments the phases differ by an orthogonal matrix at every line. An
    experiment lasts `periods` periods; in the first, the previous experiment's transient decays.
    """

    realisations: Annotated[int, Field(ge=1, le=1000)]
    periods: Annotated[int, Field(ge=3, le=1000)]


class RecordStep(Strict):
    """Write a log of `duration_s` seconds for identification, with or without excitations.

    The platform first settles for `settle_s`, in the same log. Excitations fade in and out over
    `fade_s`. With `orthogonal` the record lasts realisations x inputs x periods x `period_s`, plus
    `fade_s`. With `each_s` the excitations play one after the other, each for `each_s` at full
    level; the next one fades in while the last one fades out. `scale` multiplies the levels of the
    excitations. The trajectories `beam` and `rotor` repeat until the record ends. Without
    `beam_feedforward` the feed-forward does not carry the moving beam: it disturbs the platform.
    """

    name: Name
    duration_s: Duration | None = None
    excite: tuple[Name, ...] = ()
    orthogonal: Orthogonal | None = None
    each_s: Duration | None = None
    scale: Positive = 1.0
    settle_s: Pause = 3.0
    fade_s: Pause = 0.5
    beam: tuple[Waypoint, ...] = ()
    rotor: tuple[RotorWaypoint, ...] = ()
    beam_feedforward: bool = True

    @model_validator(mode="after")
    def _long_enough(self) -> Self:
        given = [
            key for key in ("duration_s", "orthogonal", "each_s") if getattr(self, key) is not None
        ]
        if len(given) != 1:
            raise ValueError(
                "expected exactly one of duration_s, orthogonal and each_s, which set the "
                f"record's length, found {' and '.join(given) or 'none'}"
            )
        if self.orthogonal is not None and not self.excite:
            raise ValueError("expected multisines in 'excite' with 'orthogonal', found none")
        if self.orthogonal is not None and (self.beam or self.rotor):
            raise ValueError(
                "expected no trajectory with 'orthogonal', found "
                f"{'beam' if self.beam else 'rotor'}: beam and rotor must be at rest"
            )
        if not self.beam_feedforward and not self.beam:
            raise ValueError(
                "beam_feedforward: expected false with a trajectory 'beam' only, found none: a "
                "beam at rest does not disturb the platform"
            )
        if self.each_s is not None and not self.excite:
            raise ValueError("expected excitations in 'excite' with 'each_s', found none")
        if self.each_s is not None and self.fade_s > self.each_s:
            raise ValueError(
                f"expected fade_s of at most each_s, found {self.fade_s:g} s and {self.each_s:g} s"
            )
        if self.duration_s is not None and self.duration_s <= 2 * self.fade_s:
            raise ValueError(
                f"expected duration_s longer than twice fade_s, found {self.duration_s:g} s "
                f"and {self.fade_s:g} s"
            )
        return self


class Land(Strict):
    """Descend onto the stops in `ramp_s`, then reduce the force to zero in `release_s`."""

    ramp_s: Duration = 1.5
    release_s: Duration = 0.5


class Step(Strict):
    """One step of a session: exactly one of its keys."""

    levitate: Levitate | None = None
    move: Move | None = None
    record: RecordStep | None = None
    land: Land | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        given = [k for k in ("levitate", "move", "record", "land") if getattr(self, k) is not None]
        if len(given) != 1:
            raise ValueError(
                "expected exactly one of levitate, move, record, land, found "
                f"{' and '.join(given) or 'none'}"
            )
        return self

    @property
    def kind(self) -> Literal["levitate", "move", "record", "land"]:
        """The key that is given."""
        for kind in ("levitate", "move", "record"):
            if getattr(self, kind) is not None:
                return kind
        return "land"


class SessionConfig(Strict):
    """SESSION.yaml: a flight's excitations and steps, and the commands after landing."""

    levid: Literal["session"]
    name: Name
    rate_hz: Rate | None = None
    """Rate of the loop; default: the rig's rate."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    excitations: dict[Name, Excitation] = Field(default_factory=dict, max_length=1000)
    steps: Annotated[tuple[Step, ...], Field(min_length=1, max_length=MOST_STEPS)]
    then: tuple[Literal["identify", "trace"], ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.steps[0].kind != "levitate":
            raise ValueError(f"expected the first step to be levitate, found {self.steps[0].kind}")
        if self.steps[-1].kind != "land":
            raise ValueError(f"expected the last step to be land, found {self.steps[-1].kind}")
        names: set[str] = set()
        for number, step in enumerate(self.steps):
            if number and step.kind == "levitate":
                raise ValueError(
                    f"steps[{number}]: expected levitate as the first step only, found it again"
                )
            if step.kind == "land" and number != len(self.steps) - 1:
                raise ValueError(
                    f"steps[{number}]: expected land as the last step only, found it before the end"
                )
            if step.record is None:
                continue
            if step.record.name in names:
                raise ValueError(
                    f"steps[{number}].record.name: expected a name that no other record has, found "
                    f"'{step.record.name}' again"
                )
            names.add(step.record.name)
            for excitation in step.record.excite:
                if excitation not in self.excitations:
                    known = ", ".join(sorted(self.excitations)) or "none"
                    raise ValueError(
                        f"steps[{number}].record.excite: expected a name from 'excitations' "
                        f"({known}), found '{excitation}'"
                    )
            self._check_orthogonal(step.record, f"steps[{number}].record")
        return self

    def _check_orthogonal(self, record: RecordStep, where: str) -> None:
        if record.orthogonal is None:
            return
        played = [self.excitations[name] for name in record.excite]
        for name, excitation in zip(record.excite, played, strict=True):
            if excitation.signal != "multisine":
                raise ValueError(
                    f"{where}.orthogonal: expected multisines only, found '{name}' with signal "
                    f"{excitation.signal}"
                )
            for key in ("period_s", "band_hz", "lines"):
                first, other = getattr(played[0], key), getattr(excitation, key)
                if first != other:
                    raise ValueError(
                        f"{where}.orthogonal: expected the same {key} in all excitations, found "
                        f"{quoted(first)} in '{record.excite[0]}' and {quoted(other)} in '{name}'"
                    )
        inputs = [excitation.input for excitation in played]
        if len(set(inputs)) < len(inputs):
            raise ValueError(
                f"{where}.orthogonal: expected a different input for each excitation, found "
                f"{', '.join(inputs)}"
            )
        period_s = played[0].period_s
        if period_s is not None and record.fade_s > period_s:
            raise ValueError(
                f"{where}.fade_s: expected at most one period, {period_s:g} s, found "
                f"{record.fade_s:g} s"
            )


def load_session(path: Path | str) -> SessionConfig:
    """Read a SESSION.yaml file; raises ConfigError."""
    return load_yaml(path, SessionConfig)
