"""A session: lift off, move the beam, record under excitation, land; SESSION.yaml in types."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from .base import Finite, NonNegative, Positive, Strict, load_yaml
from .rig import Rate

# A part of a file name, which has at most 255 characters.
MOST_STEPS = 1000
"""Of a session."""
Name = Annotated[str, Field(max_length=100, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
Duration = Annotated[float, Field(gt=0, le=86_400, allow_inf_nan=False)]
Pause = Annotated[float, Field(ge=0, le=86_400, allow_inf_nan=False)]
# A drive counts in 1e-7 rad and 32 bits: what is beyond would stop short there, at once.
RotorAngle = Annotated[float, Field(ge=-214.7, le=214.7, allow_inf_nan=False)]
Dof = Literal["psi", "theta", "z"]


class Excitation(Strict):
    """A signal for one input of the platform: psi, theta, z, or one coil by its number.

    `rms_n_m` is the level of a torque, `rms_n` that of a force; exactly the one that fits `input`.
    `band_hz` bounds the spectrum; without it white noise is white up to half the rate.
    A multisine repeats after `period_s`; its lines are the multiples of 1 / period_s in the band:
    all, the odd ones, or of every four odd ones in a row three (`odd_random_grid`, the fourth drawn
    by lot), so that what the plant answers at the lines left out shows how it distorts. They are of
    one amplitude, or above `rise_hz` in proportion to frequency, as masses answer less and less.
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
            raise ValueError(f"expected the level of input '{self.input}' as '{need}'")
        if self.band_hz is not None and self.band_hz[0] >= self.band_hz[1]:
            raise ValueError(f"expected band_hz [low, high] with low < high, found {self.band_hz}")
        if (self.signal == "multisine") != (self.period_s is not None):
            raise ValueError("expected 'period_s' with signal multisine, and only there")
        if self.signal == "multisine" and self.band_hz is None:
            raise ValueError("expected 'band_hz' with signal multisine")
        if self.signal != "multisine" and self.lines != "all":
            raise ValueError("expected 'lines' only with signal multisine")
        if self.signal != "multisine" and self.rise_hz is not None:
            raise ValueError("expected 'rise_hz' only with signal multisine")
        return self

    @property
    def level(self) -> float:
        """RMS level in N m (psi, theta) or N."""
        level = self.rms_n_m if self.rms_n_m is not None else self.rms_n
        assert level is not None
        return level


class Waypoint(Strict):
    """Move the beam to `to_m`, then stay for `dwell_s`; a smooth profile within the limits."""

    to_m: Finite
    velocity_m_s: Positive | None = None
    acceleration_m_s2: Positive | None = None
    dwell_s: Pause = 0.0


class RotorWaypoint(Strict):
    """Turn the rotor to `to_rad`, then stay for `dwell_s`; a smooth profile within the limits."""

    to_rad: RotorAngle
    velocity_rad_s: Positive | None = None
    acceleration_rad_s2: Positive | None = None
    dwell_s: Pause = 0.0


class CoilCheck(Strict):
    """A small push of each coil in turn, just after lift-off: forth, back twice, forth."""

    push_n: Annotated[float, Field(gt=0, le=10.0)] = 1.0
    push_s: Annotated[float, Field(gt=0, le=0.1)] = 0.008
    pause_s: Annotated[float, Field(gt=0, le=5.0)] = 0.05


class Levitate(Strict):
    """Take the weight off the stops in `unload_s`, rise in `ramp_s`, settle for `settle_s`.

    With `check_coils` each coil is pushed before the platform settles; one that does not move as
    the others do is the fault COIL_CHECK. Where nothing is said of it a daemon does so until it
    knows the coils: at the first lift-off after its start and after a fault.
    """

    unload_s: Duration = 0.5
    ramp_s: Duration = 1.5
    check_coils: CoilCheck | Literal[False] | None = None
    settle_s: Pause = 4.0


class Move(Strict):
    """Move the beam (and the rotor), then settle for `settle_s`."""

    beam_m: Finite | None = None
    rotor_rad: RotorAngle | None = None
    velocity_m_s: Positive | None = None
    acceleration_m_s2: Positive | None = None
    settle_s: Pause = 4.0


class Orthogonal(Strict):
    """How the multisines of a record play at once and can still be told apart.

    Each of the `realisations` draws phases anew and plays as many experiments as there are
    multisines, the phases of which differ by an orthogonal matrix at every line. An experiment
    lasts `periods` periods; during the first the transient of the one before dies out.
    """

    realisations: Annotated[int, Field(ge=1, le=1000)]
    periods: Annotated[int, Field(ge=3, le=1000)]


class RecordStep(Strict):
    """Log `duration_s` for identification while the named excitations play, or in silence.

    The platform first settles for `settle_s`, in the same log. Excitations fade in and out over
    `fade_s` at both ends. With `orthogonal` the record is as long as its experiments and the last
    `fade_s`. With `each_s` the excitations play in turn, each for so long at its full level, and
    fade into one another. `scale` multiplies their levels. `beam` and `rotor` are trajectories
    that repeat until the record ends.
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

    @model_validator(mode="after")
    def _long_enough(self) -> Self:
        given = [
            key for key in ("duration_s", "orthogonal", "each_s") if getattr(self, key) is not None
        ]
        if len(given) != 1:
            raise ValueError(
                "expected 'duration_s', or 'orthogonal' or 'each_s', which say how long it is; "
                f"found {' and '.join(given) or 'none of them'}"
            )
        if self.orthogonal is not None and not self.excite:
            raise ValueError("expected multisines in 'excite' with 'orthogonal', found none")
        if self.orthogonal is not None and (self.beam or self.rotor):
            raise ValueError("expected the beam at rest with 'orthogonal', found a trajectory")
        if self.each_s is not None and not self.excite:
            raise ValueError("expected names in 'excite' that play in turn with 'each_s'")
        if self.each_s is not None and self.fade_s > self.each_s:
            raise ValueError(
                f"expected fade_s of at most each_s, found {self.fade_s} s and {self.each_s} s"
            )
        if self.duration_s is not None and self.duration_s <= 2 * self.fade_s:
            raise ValueError(
                f"expected duration_s longer than twice fade_s, found {self.duration_s} s "
                f"and {self.fade_s} s"
            )
        return self


class Land(Strict):
    """Sink onto the stops in `ramp_s`, then let the force fade out over `release_s`."""

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
                f"expected exactly one of levitate, move, record, land, found {given or 'none'}"
            )
        return self

    @property
    def kind(self) -> Literal["levitate", "move", "record", "land"]:
        """Which of the keys is given."""
        for kind in ("levitate", "move", "record"):
            if getattr(self, kind) is not None:
                return kind
        return "land"


class SessionConfig(Strict):
    """SESSION.yaml."""

    levid: Literal["session"]
    name: Name
    rate_hz: Rate | None = None
    """Rate of the loop; the rig's unless given."""
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
                raise ValueError(f"steps[{number}]: expected levitate as the first step only")
            if step.kind == "land" and number != len(self.steps) - 1:
                raise ValueError(f"steps[{number}]: expected land as the last step only")
            if step.record is None:
                continue
            if step.record.name in names:
                raise ValueError(f"steps[{number}]: record name '{step.record.name}' stands twice")
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
                        f"{where}.orthogonal: expected one {key} in all its excitations, found "
                        f"{first} in '{record.excite[0]}' and {other} in '{name}'"
                    )
        inputs = [excitation.input for excitation in played]
        if len(set(inputs)) < len(inputs):
            raise ValueError(
                f"{where}.orthogonal: expected every excitation at an input of its own, found "
                f"{', '.join(inputs)}"
            )
        period_s = played[0].period_s
        if period_s is not None and record.fade_s > period_s:
            raise ValueError(
                f"{where}.fade_s: expected at most one period, {period_s:g} s, found "
                f"{record.fade_s:g} s"
            )


def load_session(path: Path | str) -> SessionConfig:
    """Read SESSION.yaml; raises ConfigError."""
    return load_yaml(path, SessionConfig)
