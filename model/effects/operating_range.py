"""Determine the range of motion, commands and time in records: search range of effects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .base import Array, Places, Signals

MAINS_HZ = (50.0, 60.0)
TRAVEL = 4.0
"""Travel over the standard deviation of a motion."""

# Typical operation of the rig: corners move 0.3 mm RMS at about 5 Hz, coils give up to 12 N.
_TYPICAL_GAP = 3e-4
_TYPICAL_HZ = 5.0
_TYPICAL_COMMAND = 12.0
EXCURSION = 3.0
"""Largest excursion over the standard deviation, of positions and commands."""
_TYPICAL_BEAM_M = 0.2
_TYPICAL_LATE_S = 2e-3
_TYPICAL_HIGHEST_HZ = 100.0
_SLOWEST_HZ, _OCTAVES = 1e-3, 6
_RESOLVED = 0.4
"""Largest resolvable frequency over the sampling rate."""


@dataclass(frozen=True)
class Extent:
    """Range of motion, commands and time in the records of a session, in the plant's units.

    reach, speed (n,): RMS deviation and speed of each DOF, in the record with the largest ones.
    gap: RMS motion at a sensor. command: largest actuator command. largest: that of each actuator,
    if known. beam_m: travel of the beam.
    spans_s: begin and end of each record, in the session's time. stuck: sensors with frozen
    readings while the platform moves. tones_hz: frequencies of the lines to search. middle (n,),
    beam_middle_m: mean position of each DOF and of the beam, rounded to a tenth of their motion.
    fastest_hz: highest frequency without aliasing at the lowest sampling rate. late_s: sum of the
    model's delay and lag. commands: mean and standard deviation of each actuator's command, three
    digits. resonances: bending pattern, frequency in Hz and damping ratio seen in the readings.
    dof_resonances: number of the DOF, frequency in Hz and damping ratio of masses on springs seen
    in forces and motion. beam_rates: largest speed and acceleration of the beam and largest speed
    of the rotor. joints: RMS deviation and speed, and middle, of each relative motion. periods: for
    each DOF, those over its position that the missing force has; rubbing: those that it times the
    direction has; scales: those that it has in proportion to the squared speed. ripples: for each
    actuator, those over its position that the missing share of its force has.
    """

    reach: tuple[float, ...]
    speed: tuple[float, ...]
    gap: float
    command: float
    beam_m: float
    spans_s: tuple[tuple[float, float], ...] = ()
    tones_hz: tuple[float, ...] = MAINS_HZ
    stuck: tuple[int, ...] = ()
    middle: tuple[float, ...] = ()
    beam_middle_m: float = 0.0
    fastest_hz: float = math.inf
    late_s: float = _TYPICAL_LATE_S
    commands: tuple[tuple[float, float], ...] = ()
    resonances: tuple[tuple[str, float, float], ...] = ()
    beam_rates: tuple[float, float, float] = (0.0, 0.0, 0.0)
    dof_resonances: tuple[tuple[int, float, float], ...] = ()
    largest: tuple[float, ...] = ()
    joints: tuple[tuple[float, float, float], ...] = ()
    periods: tuple[tuple[float, ...], ...] = ()
    rubbing: tuple[tuple[float, ...], ...] = ()
    ripples: tuple[tuple[float, ...], ...] = ()
    scales: tuple[tuple[float, ...], ...] = ()

    def largest_command(self, coils: Sequence[int]) -> float:
        """Return the largest command of some actuators: inputs can have different units."""
        return max((self.largest[c] for c in coils if self.largest), default=0.0) or self.command

    def mean_command(self, coil: int) -> float:
        """Return an actuator's mean command; 0 if it is less than its standard deviation.

        Its sign is the direction of the current, which a small mean does not tell.
        """
        if not self.commands or abs(self.commands[coil][0]) < self.commands[coil][1]:
            return 0.0
        return self.commands[coil][0]

    def command_spread(self, coil: int) -> float:
        """Return the standard deviation of an actuator's command; of one that is constant or not
        known a third of the largest command."""
        found = self.commands[coil][1] if self.commands else 0.0
        return found or self.largest_command((coil,)) / EXCURSION

    @property
    def highest_hz(self) -> float:
        """Highest frequency without aliasing, that of a typical record if none is known."""
        return self.fastest_hz if math.isfinite(self.fastest_hz) else _TYPICAL_HIGHEST_HZ

    @property
    def slowest_hz(self) -> float:
        """Lowest frequency of which the longest record has a whole cycle."""
        longest = max((end - begin for begin, end in self.spans_s), default=0.0)
        return 1.0 / longest if longest > 0.0 else _SLOWEST_HZ

    def resonance_starts_hz(self) -> tuple[float, ...]:
        """Return start values of a resonance, a third of an octave apart, at most six octaves below
        the highest frequency; none if the records do not bound it."""
        if math.isinf(self.fastest_hz):
            return ()
        starts = (self.fastest_hz / 2.0 ** (k / 3.0) for k in range(1, 3 * _OCTAVES + 1))
        return tuple(f for f in starts if f > 2.0 * self.slowest_hz)

    def around(self, dof: int) -> float:
        """Return the mean position of a DOF."""
        return self.middle[dof] if self.middle else 0.0

    @classmethod
    def typical(cls, places: Places) -> Extent:
        """Return the rig's typical range, to build the effects table without a record."""
        arms = np.abs(places.sensor_shape).max(axis=0)
        reach = tuple(float(_TYPICAL_GAP / arm) for arm in arms)
        speed = tuple(2 * math.pi * _TYPICAL_HZ * r for r in reach)
        return cls(
            reach, speed, _TYPICAL_GAP, _TYPICAL_COMMAND, _TYPICAL_BEAM_M,
            stuck=tuple(range(places.sensors)),
            joints=tuple(
                (float(np.abs(j.motion) @ reach), float(np.abs(j.motion) @ speed), 0.0)
                for j in places.joints
            ),
        )  # fmt: skip

    @classmethod
    def measured(
        cls,
        records: Sequence[Signals],
        tones_hz: tuple[float, ...] = MAINS_HZ,
        resonances: tuple[tuple[str, float, float], ...] = (),
        dof_resonances: tuple[tuple[int, float, float], ...] = (),
    ) -> Extent:
        """Return the range of records; lines and resonances are those found in them."""
        shape = records[0].places.sensor_shape
        reach = _liveliest([r.q for r in records])
        places = np.concatenate([r.q for r in records]).mean(axis=0).tolist()
        beam = [float(edge([edge(r.x_b_m) for r in records])) for edge in (np.min, np.max)]
        return cls(
            reach,
            _liveliest([r.qd for r in records]),
            max(_liveliest([r.q @ shape.T for r in records])),
            # Without commands any size is valid: use the rig's.
            max(float(np.abs(r.coil).max()) for r in records) or _TYPICAL_COMMAND,
            beam[1] - beam[0],
            tuple((float(r.time_s[0]), float(r.time_s[-1])) for r in records),
            tones_hz,
            _standing(records),
            tuple(_rounded(place, size) for place, size in zip(places, reach, strict=True)),
            _rounded(0.5 * (beam[0] + beam[1]), 0.5 * (beam[1] - beam[0])),
            _RESOLVED / max(r.Ts_s for r in records),
            max(r.delay_cycles * r.Ts_s + r.lag_s for r in records),
            _commands(records),
            resonances,
            _beam_rates(records),
            dof_resonances,
            tuple(np.max([np.abs(r.coil).max(axis=0) for r in records], axis=0).tolist()),
            tuple(_relative(records, j.motion[:, None]) for j in records[0].places.joints),
        )


def _relative(records: Sequence[Signals], motion: Array) -> tuple[float, float, float]:
    """Return RMS deviation and speed, and the middle, of a relative motion (n, 1)."""
    reach = _liveliest([r.q @ motion for r in records])[0]
    speed = _liveliest([r.qd @ motion for r in records])[0]
    middle = float(np.concatenate([r.q @ motion for r in records]).mean())
    return reach, speed, _rounded(middle, reach)


def _commands(records: Sequence[Signals]) -> tuple[tuple[float, float], ...]:
    """Return mean and standard deviation of each command; () if a command is constant."""
    commands = np.concatenate([r.coil for r in records])
    pairs = zip(commands.mean(axis=0).tolist(), commands.std(axis=0).tolist(), strict=True)
    found = tuple((float(f"{mean:.3g}"), float(f"{sd:.3g}")) for mean, sd in pairs)
    return found if all(sd > 0.0 for _, sd in found) else ()


def _beam_rates(records: Sequence[Signals]) -> tuple[float, float, float]:
    """Return the largest speed and acceleration of the beam, and speed of the rotor."""
    v, a, phi = (
        max(float(np.abs(x).max(initial=0.0)) for x in each)
        for each in (
            [r.v_b_m_s for r in records],
            [r.a_b_m_s2 for r in records],
            [r.phi_rad_s for r in records],
        )
    )
    return v, a, phi


def _rounded(middle: float, size: float) -> float:
    """Return a mean rounded to a tenth of the motion about it and three digits, as in a key."""
    if size <= 0.0:
        return 0.0
    return float(f"{round(middle / (0.1 * size)) * 0.1 * size:.3g}")


def _standing(records: Sequence[Signals]) -> tuple[int, ...]:
    """Return the sensors with frozen readings in any record."""
    masks = [r.stuck.any(axis=0) for r in records if r.stuck is not None]
    return tuple(np.flatnonzero(np.any(masks, axis=0)).tolist()) if masks else ()


def _liveliest(signals: Sequence[Array]) -> tuple[float, ...]:
    """Return the largest standard deviation of each column, never zero."""
    largest = np.max([s.std(axis=0) for s in signals], axis=0)
    return tuple(float(v) for v in np.maximum(largest, 1e-12))
