"""Count cycles per second of the daemon's loop in virtual time, with plant and log.

The peer is a simple loop: numpy for control and plant, and mcap's own writer.
"""

from __future__ import annotations

import struct
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter

import numpy as np
from mcap.writer import Writer

from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure
from levid.config.base import parse_text
from levid.config.model import load_model
from levid.config.rig import load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.daemon.loop.clock import VirtualClock
from levid.daemon.loop.virtual_flight import Flight
from levid.daemon.planning.plan import plan_session
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.log.signals import cycle_dtype, ros2msg
from levid.model.geometry import decoupling_matrix
from levid.model.second_order import discretise

RIG_FILE = shipped("rigs/loopback.yaml")
SESSION = """
levid: session
name: bench
excitations: {{psi: {{input: psi, rms_n_m: {level}}}}}
steps:
  - levitate: {{settle_s: 0.1}}
  - record: {{name: psi, duration_s: {duration}, settle_s: 0, excite: [psi]}}
  - land: {{}}
"""


def measure(quick: bool) -> Iterator[Figure]:
    """Run all contenders in turn; yield their median rates."""
    rates: dict[str, list[float]] = defaultdict(list)
    cycles = 60_000 if quick else 200_000
    for _ in range(3 if quick else 7):
        for name, rate_hz, part in (("1khz", 1000.0, 2), ("10khz", 10_000.0, 1)):
            rates[f"cycles_per_s_{name}"].append(levid_rate(rate_hz, cycles // part))
            rates[f"peer_{name}"].append(peer_rate(rate_hz, cycles // 6))
    for key, found in rates.items():
        ours, rate = not key.startswith("peer"), key.rpartition("_")[2]
        label = "virtual time, plant and log" if ours else "numpy and mcap's writer"
        versus = f"peer_{rate}" if ours else None
        yield Figure(key, float(np.median(found)), "1/s", f"{rate}: {label}", versus)


def levid_rate(rate_hz: float, cycles: int) -> float:
    """Return cycles per second, from the first cycle to the last byte on disk."""
    rig = load_rig(RIG_FILE).model_copy(update={"sim": str(shipped("sims/nominal.yaml"))})
    # The same spectral density at either rate.
    text = SESSION.format(duration=cycles / rate_hz, level=0.1 * np.sqrt(rate_hz / 1000))
    session = parse_text(text, SessionConfig, "benchmark")
    with (
        tempfile.TemporaryDirectory() as folder,
        Flight(rig, RIG_FILE.parent, rate_hz, VirtualClock()) as flight,
    ):
        plan = plan_session(session, rig)
        start = perf_counter()
        result = flight.fly(plan, Path(folder), {})
        return result.cycles / (perf_counter() - start)


def peer_rate(rate_hz: float, cycles: int) -> float:
    """Return cycles per second of the peer: numpy for every step, mcap's writer for the log."""
    rig, Ts = load_rig(RIG_FILE), 1 / rate_hz
    T = decoupling_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
    model = declared_model(load_model(shipped("models/rig.yaml"))).at()
    internal_s = 1e-4
    steps = round(Ts / internal_s)
    plant = discretise(model, internal_s)
    kp, ki = np.array(rig.control.kp), np.array(rig.control.ki)
    rng = np.random.default_rng(1)
    x, integral, u = np.zeros(len(plant.A)), np.zeros(3), np.zeros(3)
    dtype = cycle_dtype(9, 9)
    pack = struct.Struct(f"<4xQd{(dtype.itemsize - 20) // 4}f4x").pack
    rest = [0.0] * ((dtype.itemsize - 20) // 4 - 21)
    with tempfile.TemporaryFile() as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema("levid/msg/Cycle", "ros2msg", ros2msg(dtype).encode())
        channel = writer.register_channel("/levid/cycle", "cdr", schema)
        start = perf_counter()
        for k in range(cycles):
            for _ in range(steps):
                noise = T @ rng.normal(0.0, 1e-3, 9)
                x = plant.A @ x + plant.B @ (u + noise)
            gap = T.T @ (plant.C @ x) + rng.normal(0.0, 1e-7, 9)
            q = T @ gap
            integral += ki * Ts * -q
            u = np.clip(-kp * q + integral + rng.normal(0.0, 0.1, 3), -50.0, 50.0)
            coil = T.T @ u
            row = pack(k, k * Ts, *gap, *q, *coil, *rest)
            time_ns = round(k * Ts * 1e9)
            writer.add_message(channel, time_ns, row, time_ns)
        writer.finish()
        return cycles / (perf_counter() - start)


if __name__ == "__main__":
    benchmark_runner.run("The loop in virtual time", measure)
