"""Fly white noise with changed records, rig or plant, and know the true Markov parameters."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from levid.benchmarks.harness.virtual_flight import RIG, SIM, fly_session
from levid.benchmarks.identification.simulated_flight_and_truth import LAG_S
from levid.config.base import parse, read_mapping
from levid.config.shipped import shipped
from levid.config.sim import SimConfig
from levid.identification.nonparametric.markov_parameters import estimate_markov
from levid.identification.options import Options
from levid.identification.records.from_log import from_log
from levid.identification.records.record import PiController, Record
from levid.identification.subspace.delay_removal import without_delay
from levid.identification.subspace.hankel_operator import HankelOperator, leading_svd
from levid.identification.subspace.ho_kalman import Scaling, decompose
from levid.identification.subspace.plant_from_loop import closed_loop
from levid.log.reader import read_log
from levid.model.second_order import StateSpace
from levid.sim.true_response import state_space

Array = NDArray[np.float64]

ORDER = 9
"""States of the loop without delay and lag."""
DECAYED_S = 12.0
"""Until then the slowest mode of the loop decays to 3e-5."""


@dataclass(frozen=True)
class Flight:
    """The training rows of a flight's records, and what is known of the loop that was flown.

    g (12 s, 3, 3) are the true Markov parameters, `decay_1_s` the mean decay rate of the three
    resonances; both follow from the simulator's parameters. A record excites one input, or all.
    """

    records: tuple[Record, ...]
    g: Array
    decay_1_s: float

    @cached_property
    def scaling(self) -> Scaling:
        return Scaling.of(self.records)

    @cached_property
    def excited(self) -> tuple[Array, Array, int]:
        """Rms of the outputs (3, 3) while each input moves, of the inputs (3,), and these rows."""
        outputs, inputs, rows = np.empty((3, 3)), np.empty(3), 0
        for j in range(3):
            record = self.records[j if len(self.records) == 3 else 0]
            moving = record.v[:, j] != 0  # the platform settles before
            outputs[:, j] = (record.y - record.y.mean(axis=0))[moving].std(axis=0)
            inputs[j], rows = record.v[moving, j].std(), int(moving.sum())
        return outputs, inputs, rows

    def taps(self, seconds: float) -> int:
        return round(seconds / self.records[0].Ts_s)

    def estimate(self, seconds: float, method: str = "correlation") -> Array:
        return estimate_markov(self.records, self.taps(seconds), method).g

    def singular_values(self, g: Array, scaling: Scaling | None = None) -> Array:
        """Return the singular values of Ho-Kalman, as `identify` computes them."""
        scaling = scaling or self.scaling
        return decompose(self._core(g), self.records[0].Ts_s, scaling).singular_values

    def with_delay(self, g: Array) -> Array:
        """Return the singular values if the known delay and lag are not removed."""
        return decompose(g, self.records[0].Ts_s, self.scaling).singular_values

    def true_singular_values(self, taps: int) -> Array:
        """Return the ORDER singular values of the true g.

        The matrix has exactly this rank: its products with a few random vectors determine them.
        """
        hankel = self._hankel(self._core(self.g[:taps]))
        start = np.random.default_rng(0).normal(size=(hankel.shape[1], 2 * ORDER))
        Q = np.linalg.qr(hankel.matmat(start))[0]
        return np.linalg.svd(hankel.adjoint().matmat(Q), compute_uv=False)[:ORDER]

    def error_ratio(self, singular_values: Array, taps: int) -> float:
        """Return s(10) of an estimate over s(9) of the true g."""
        return float(singular_values[ORDER] / self.true_singular_values(taps)[-1])

    def largest_of_error(self, g: Array) -> float:
        """Return the largest singular value of the Hankel matrix of the error of an estimate."""
        error = self._core(g) - self._core(self.g[: len(g)])
        return float(leading_svd(self._hankel(error), ORDER).s[0])

    def _core(self, g: Array) -> Array:
        first = self.records[0]
        pole = float(np.exp(-first.Ts_s / LAG_S))
        return without_delay(g, first.leading_zeros, pole, first.controller, first.Ts_s)

    def _hankel(self, g: Array) -> HankelOperator:
        scaled = g * (self.scaling.inputs / self.scaling.outputs[:, None])
        blocks = (len(g) - 1) // 2
        return HankelOperator(scaled[1:], blocks, blocks)


def fly(
    seed: int,
    duration_s: float = 60.0,
    rate_hz: int = 1000,
    *,
    together: bool = False,
    scale: float = 1.0,
    excitation: Mapping[str, object] | None = None,
    sim: Mapping[str, Mapping[str, float]] | None = None,
    integral: float = 1.0,
) -> Flight:
    """Fly white noise at psi, theta and z for `duration_s` each, in turn or all `together`.

    `scale` multiplies the excitation, `integral` the controller's integral gains. `excitation` and
    `sim` replace keys of the session's excitations and of SIM.yaml.
    """
    session = read_mapping(shipped(f"sessions/white-noise-{rate_hz // 1000}khz.yaml"))
    axes = list(session["excitations"])
    steps = [
        {"name": "-".join(names), "duration_s": duration_s, "excite": names, "scale": scale}
        for names in ([axes] if together else [[axis] for axis in axes])
    ]
    session["steps"] = [{"levitate": {}}, *({"record": step} for step in steps), {"land": {}}]
    for signals in session["excitations"].values():
        signals.update(excitation or {})
    rig = {**read_mapping(RIG), "model": read_mapping(shipped("models/rig.yaml"))}
    for gains in rig["control"].values():
        gains.update({key: integral * gains[key] for key in gains if key.startswith("ki")})
    plant = read_mapping(SIM)
    for section, values in (sim or {}).items():
        plant[section].update(values)
    with tempfile.TemporaryDirectory() as folder:
        sim_file = Path(folder, "plant.yaml")
        sim_file.write_text(yaml.safe_dump(plant))
        session.update({"seed": seed, "then": []})
        logs = fly_session(session, Path(folder, "logs"), rig=rig, sim=sim_file)
        flown = [from_log(read_log(path)) for path in logs]
    nominal = flown[0].controller  # the logs contain the shipped rig, without changed gains
    assert nominal is not None
    controller = PiController(nominal.kp, integral * nominal.ki)
    true = parse(plant, SimConfig, str(SIM))
    loop = closed_loop(state_space(true, 0.0, rate_hz), controller)
    held_out = 0.0 if excitation else Options().holdout  # as identify; periodic: two whole periods
    training = [r.rows(0, round((1.0 - held_out) * len(r.y))) for r in flown]
    return Flight(
        tuple(replace(record, controller=controller) for record in training),
        impulse_response(loop, round(DECAYED_S * rate_hz)),
        resonance_decay(loop),
    )


def impulse_response(loop: StateSpace, taps: int) -> Array:
    g, x = np.empty((taps, *loop.D.shape)), loop.B
    g[0] = loop.D
    for k in range(1, taps):
        g[k], x = loop.C @ x, loop.A @ x
    return g


def resonance_decay(loop: StateSpace) -> float:
    """Return the mean decay rate in 1/s of the loop's oscillating modes."""
    poles = np.linalg.eigvals(loop.A)
    oscillating = poles[(np.abs(poles) > 0.5) & (poles.imag > 1e-6)]
    return float(-np.log(np.abs(oscillating)).mean() / loop.Ts_s)
