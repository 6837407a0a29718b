"""How far, how fast and how long a plant was driven: where nonlinear parameters are looked for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .base import Array, Places, Signals

MAINS_HZ = (50.0, 60.0)

# What the platform is meant to do: corners move 0.3 mm rms at about 5 Hz, coils give 12 N at most.
_TYPICAL_GAP = 3e-4
_TYPICAL_HZ = 5.0
_TYPICAL_COMMAND = 12.0
_TYPICAL_BEAM_M = 0.2
_TYPICAL_LATE_S = 2e-3
_RESOLVED = 0.4
"""Of the rate of sampling."""


@dataclass(frozen=True)
class Extent:
    """What the records of a session cover, in the plant's own units.

    reach, speed (n,): how far from its middle and how fast each DOF moves, rms, in the liveliest
    record. gap: how far a single sensor moves. command: the largest of a single actuator. beam_m:
    the length that the beam travels. spans_s: begin and end of each record, in the session's time.
    standing: sensors whose readings stand still now and then while the platform moves.
    tones_hz: frequencies of the lines that are looked for. middle (n,), beam_middle_m: what each
    DOF and the beam move about, to a tenth of their motion. fastest_hz: up to where the slowest
    sampling tells resonances from their aliases. late_s: by how much the model has commands come
    late, delay and lag together. commands: of each actuator mean and standard deviation of what it
    is told, to three digits. resonances: name of a pattern of bending, frequency in Hz and damping
    of what the readings show of it. beam_rates: how fast the beam goes and how hard it is sped up,
    and how fast the rotor turns, at most; 0 where they do not.
    """

    reach: tuple[float, ...]
    speed: tuple[float, ...]
    gap: float
    command: float
    beam_m: float
    spans_s: tuple[tuple[float, float], ...] = ()
    tones_hz: tuple[float, ...] = MAINS_HZ
    standing: tuple[int, ...] = ()
    middle: tuple[float, ...] = ()
    beam_middle_m: float = 0.0
    fastest_hz: float = math.inf
    late_s: float = _TYPICAL_LATE_S
    commands: tuple[tuple[float, float], ...] = ()
    resonances: tuple[tuple[str, float, float], ...] = ()
    beam_rates: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def around(self, dof: int) -> float:
        """Return what a DOF moves about."""
        return self.middle[dof] if self.middle else 0.0

    @classmethod
    def typical(cls, places: Places) -> Extent:
        """Return what the rig is built for: good enough to lay out the table without a record."""
        arms = np.abs(places.sensor_shape).max(axis=0)
        reach = tuple(float(_TYPICAL_GAP / arm) for arm in arms)
        speed = tuple(2 * math.pi * _TYPICAL_HZ * r for r in reach)
        return cls(
            reach, speed, _TYPICAL_GAP, _TYPICAL_COMMAND, _TYPICAL_BEAM_M,
            standing=tuple(range(places.sensors)),
        )  # fmt: skip

    @classmethod
    def measured(
        cls,
        records: Sequence[Signals],
        tones_hz: tuple[float, ...] = MAINS_HZ,
        resonances: tuple[tuple[str, float, float], ...] = (),
    ) -> Extent:
        """Return what records cover; tones_hz and resonances as found in them."""
        shape = records[0].places.sensor_shape
        reach = _liveliest([r.q for r in records])
        places = np.concatenate([r.q for r in records]).mean(axis=0).tolist()
        beam = [float(edge([edge(r.x_b_m) for r in records])) for edge in (np.min, np.max)]
        return cls(
            reach,
            _liveliest([r.qd for r in records]),
            max(_liveliest([r.q @ shape.T for r in records])),
            # Nothing was commanded: any size will do, and is laid out like a rig's.
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
        )


def _commands(records: Sequence[Signals]) -> tuple[tuple[float, float], ...]:
    """Return mean and standard deviation of each command; none where one stands still."""
    told = np.concatenate([r.coil for r in records])
    pairs = zip(told.mean(axis=0).tolist(), told.std(axis=0).tolist(), strict=True)
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
    """Return a middle to a tenth of the motion about it, three digits: as it stands in a key."""
    if size <= 0.0:
        return 0.0
    return float(f"{round(middle / (0.1 * size)) * 0.1 * size:.3g}")


def _standing(records: Sequence[Signals]) -> tuple[int, ...]:
    """Return the sensors whose readings stand still somewhere."""
    masks = [r.standing.any(axis=0) for r in records if r.standing is not None]
    return tuple(np.flatnonzero(np.any(masks, axis=0)).tolist()) if masks else ()


def _liveliest(signals: Sequence[Array]) -> tuple[float, ...]:
    """Return the largest standard deviation of each column, never zero."""
    largest = np.max([s.std(axis=0) for s in signals], axis=0)
    return tuple(float(v) for v in np.maximum(largest, 1e-12))
