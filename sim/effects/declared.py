"""Apply the effects of a model file, as written by a trace, to the simulated plant.

    effects: [{use: "levid.sim.effects.declared:FromModel", model: out/trace/found/model.yaml}]

These are the equations that the trace fits, so that a traced model can be flown. To test a trace,
use the other effects of this package, which are implemented independently.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...config.model import ModelConfig, load_model
from ...config.shipped import find_file
from ...model.effects.base import Placed, Places, Signals, Term, total
from ...model.effects.combined_effects import together
from ...model.effects.effect_serialization import placed_effects
from ...model.geometry import shape_matrix
from ..plant_kernels import Array
from .effect_interface import BeamState, EffectPlant

_HISTORY_S = 4.0
_EVERY_S = 1e-3
_FEWEST_ROWS = 3
_PROBE_ROWS = 60
_SIZES = (1e-5, 1e-3, 1.0)
"""Sizes of the test motion that detects memory: from below break-away to far above."""
_SAME = 1e-9


class FromModel:
    """All effects of a model file.

    Effects without memory are evaluated in every step. Effects with memory (friction, lags, modes,
    heat) are evaluated every millisecond over the last 4 s, and held in between.

    Raises:
        ConfigError: the file is not a valid model.
        ModelError: an effect in it is unknown or wrong.
    """

    def __init__(self, model: str) -> None:
        self._config = load_model(find_file(model, "model"))

    def reset(self, plant: EffectPlant) -> None:
        """Build the effects for the plant's coils and sensors."""
        places = _places(self._config, plant)
        placed = placed_effects(self._config.effects, places)
        present = [p for p in placed if not _has_memory(p, places)]
        # Each hook evaluates only the effects that contribute to it.
        self._present = {
            kind: [
                p
                for p in present
                if getattr(p.term(_random_motion(places, 0, 1.0)), kind) is not None
            ]
            for kind in ("held", "force", "gap", "drive")
        }
        every = max(round(_EVERY_S / plant.dt_s), 1)
        past = [p for p in placed if _has_memory(p, places)]
        self._past = _Past(past, places, every * plant.dt_s)
        self._places, self._dt_s = places, plant.dt_s
        self._row = _at_rest(places)
        self._from_coils = np.linalg.pinv(places.coil_shape.T)
        self._last_t_s: float | None = None

    def coil_force(self, t_s: float, q: Array, force_n: Array) -> Array:
        """Return the coil forces (C,) in N: the effects' wrench as the least-norm forces."""
        if not self._past and not self._present["held"]:
            return force_n
        self._row = replace(self._row, time_s=np.array([t_s]), q=q[None], coil=force_n[None])
        held = self._sum("held")
        return force_n if held is None else force_n + self._from_coils @ held

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Array:
        """Return the effects' generalised forces (3,)."""
        qdd = np.zeros_like(qd)
        if self._last_t_s is not None and t_s > self._last_t_s:
            qdd = (qd - self._row.qd[0]) / (t_s - self._last_t_s)
        motion = (beam.x_m, beam.v_m_s, beam.a_m_s2, beam.phi_rad, beam.phi_rad_s, beam.phi_rad_s2)
        x_b, v_b, a_b, phi, phi_rate, phi_rate2 = (np.array([value]) for value in motion)
        # The force is held over the step: without half a step of lead a spring damps negatively.
        ahead = q + 0.5 * self._dt_s * qd
        self._row = replace(
            self._row, time_s=np.array([t_s]), q=ahead[None], qd=qd[None], qdd=qdd[None],
            x_b_m=x_b, v_b_m_s=v_b, a_b_m_s2=a_b,
            phi_rad=phi, phi_rad_s=phi_rate, phi_rad_s2=phi_rate2,
        )  # fmt: skip
        self._last_t_s = t_s
        # Effects with memory are held longer and need half of that hold time as lead.
        later = q + 0.5 * self._past.step_s * qd
        self._past.append(replace(self._row, q=later[None]))
        force = self._sum("force")
        return np.zeros(len(q)) if force is None else force

    def beam_force(self, _t_s: float, _beam: BeamState, _q: Array, _qd: Array) -> float:
        """Return the force on the beam in N, which its drives compensate."""
        if not self._past and not self._present["drive"]:
            return 0.0
        drive = self._sum("drive")
        return 0.0 if drive is None else -float(drive)

    def gap(self, t_s: float, gap_m: Array) -> Array:
        """Return the gaps as the sensors measure them (S,) in m."""
        if not self._past and not self._present["gap"]:
            return gap_m
        pose = self._places.decoupling @ gap_m
        self._row = replace(self._row, time_s=np.array([t_s]), q=pose[None])
        added = self._sum("gap")
        return gap_m if added is None else gap_m + added

    def _sum(self, kind: str) -> Array | None:
        """Return the present sum of all effects for held, force, gap or drive; None if none."""
        present = together(self._present[kind], self._row)
        both = total([present, self._past.term])
        values: Array | None = getattr(both, kind)
        return None if values is None else np.asarray(values[0])


class _Past:
    """The last seconds of the motion, one row per millisecond, and the effects' term at its end."""

    def __init__(self, placed: Sequence[Placed], places: Places, step_s: float) -> None:
        self._placed, self._places, self.step_s = placed, places, step_s
        self._most = round(_HISTORY_S / step_s)
        # Twice the needed length, so that rows are rarely moved.
        self._table = np.zeros((2 * self._most, len(_flat(_at_rest(places)))))
        self._rows, self._next_s = 0, -np.inf
        self.term = Term()

    def __bool__(self) -> bool:
        return bool(self._placed)

    def append(self, row: Signals) -> None:
        """Append a row, at most one per millisecond, and evaluate the effects at it."""
        t_s = float(row.time_s[0])
        if not self or t_s < self._next_s - 0.1 * self.step_s:
            return
        self._next_s = t_s + self.step_s
        if self._rows == len(self._table):
            self._table[: self._most] = self._table[self._most :]
            self._rows = self._most
        self._table[self._rows] = _flat(row)
        self._rows += 1
        if self._rows < _FEWEST_ROWS:
            return
        along = _along(self._table[max(self._rows - self._most, 0) : self._rows], self._places)
        sums = together(self._placed, replace(along, Ts_s=self.step_s))
        self.term = Term(*(None if part is None else part[-1:] for part in sums.parts))


def _places(config: ModelConfig, plant: EffectPlant) -> Places:
    g = plant.geometry
    coil_xy, sensor_xy = (g.coil_x_m, g.coil_y_m), (g.sensor_x_m, g.sensor_y_m)
    return Places(
        tuple(q.name for q in config.dof),
        tuple(q.unit for q in config.dof),
        shape_matrix(*(x.tolist() for x in coil_xy)),
        shape_matrix(*(x.tolist() for x in sensor_xy)),
        "N",
        tuple(q.unit for q in config.inputs),
        "m",
        np.stack(coil_xy, axis=1),
        np.stack(sensor_xy, axis=1),
        beam=True,
    )


def _has_memory(placed: Placed, places: Places) -> bool:
    """Return whether an effect's present value differs for two different pasts."""
    for size in _SIZES:
        first, second = (
            np.concatenate([part[-1].ravel() for part in parts if part is not None])
            for parts in (placed.term(_random_motion(places, seed, size)).parts for seed in (1, 2))
        )
        if np.any(np.abs(first - second) > _SAME * np.abs([first, second]).max()):
            return True
    return False


def _random_motion(places: Places, seed: int, size: float) -> Signals:
    """Return a random motion; its last row does not depend on the seed."""
    width = len(_flat(_at_rest(places)))
    table = size * np.random.default_rng(seed).standard_normal((_PROBE_ROWS, width))
    table[-1] = size * np.random.default_rng(0).standard_normal(width)
    table[:, -1] = _EVERY_S * np.arange(_PROBE_ROWS)
    return _along(table, places)


def _flat(row: Signals) -> Array:
    """Return the values of a row as one vector, time last."""
    beam = (row.x_b_m, row.v_b_m_s, row.a_b_m_s2, row.phi_rad, row.phi_rad_s, row.phi_rad_s2)
    return np.concatenate([row.q[0], row.qd[0], row.qdd[0], row.coil[0], *beam, row.time_s])


def _along(table: Array, places: Places) -> Signals:
    """Return the trajectory with such vectors as rows (N, .)."""
    n, coils = len(places.dof), places.coils
    q, qd, qdd, coil, beam = np.split(table, np.cumsum([n, n, n, coils]), axis=1)
    x_b, v_b, a_b, phi, phi_rate, phi_rate2, time_s = beam.T
    return Signals(
        _EVERY_S, time_s, q, qd, qdd, coil, x_b, v_b, a_b, phi, phi_rate, phi_rate2, 0, places
    )


def _at_rest(places: Places) -> Signals:
    n = len(places.dof)
    return _along(np.zeros((1, 3 * n + places.coils + 7)), places)
