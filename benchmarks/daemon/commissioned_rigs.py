"""Commission rigs with wrong wiring: everything wrong has to be found, and nothing else.

Rigs are drawn with swapped channels, wrong signs, scale errors of 20 %, dead coils and stuck
sensors; one in six is right. They are simulated in this process (loopback), and by `levid
electronics` in a process of its own on CAN and serial, at 250 Hz: the emulated buses share this
machine's processors with the host. Right is a rig whose every channel has its place, sign and scale
(of a sensor within 2 %, of a coil within 5 % of the median), whose dead channels are named, and of
which nothing else is said; the force of a coil must stay below the limit.

--quick: 6 rigs in process, 2 on each bus; otherwise 120 and 60, an hour.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.config.rig import RigConfig, load_rig
from levid.config.shipped import shipped
from levid.daemon.commissioning.commission import Commissioned, Hold, Stops, commission
from levid.daemon.commissioning.corrections import corrections, problems, sensor_scale
from levid.daemon.commissioning.device_session import DeviceSession
from levid.drivers.base import Context
from levid.drivers.loopback import LoopbackBackend

CHANNELS = 9
FORCE_N = 4.9
"""A fourteenth of the platform's weight."""
STOPS = Stops((0.12, 0.12), 1.8e-3)
SENSOR_OFF, COIL_OFF = 0.02, 0.05
BUS_RATE_HZ = 250
FIRST_SEED = 36_000
_START_S = 30.0


@dataclass(frozen=True)
class Wiring:
    """The wiring of a drawn rig: see levid.sim.effects.wiring; dead and stuck are channels."""

    coil_order: tuple[int, ...] = tuple(range(CHANNELS))
    coil_scale: tuple[float, ...] = (1.0,) * CHANNELS
    sensor_order: tuple[int, ...] = tuple(range(CHANNELS))
    sensor_scale: tuple[float, ...] = (1.0,) * CHANNELS
    dead_coil: int | None = None
    stuck_sensor: int | None = None

    @property
    def right(self) -> bool:
        """Whether nothing is wrong with it."""
        return self == Wiring()

    def effect(self) -> dict[str, Any]:
        """Return the entry of a SIM.yaml."""
        coil, sensor = list(self.coil_scale), list(self.sensor_scale)
        if self.dead_coil is not None:
            coil[self.dead_coil] = 0.0
        if self.stuck_sensor is not None:
            sensor[self.stuck_sensor] = 0.0
        return {
            "use": "levid.sim.effects.wiring:Wiring",
            "coil_order": list(self.coil_order),
            "coil_scale": coil,
            "sensor_order": list(self.sensor_order),
            "sensor_scale": sensor,
        }


def drawn(seed: int) -> Wiring:
    """Return the wiring of a rig; one in six is right."""
    if seed % 6 == 5:
        return Wiring()
    rng = np.random.default_rng(seed)

    def order() -> tuple[int, ...]:
        found = np.arange(CHANNELS)
        for _ in range(rng.integers(0, 3)):
            i, j = rng.choice(CHANNELS, 2, replace=False)
            found[[i, j]] = found[[j, i]]
        return tuple(found.tolist())

    def scale() -> tuple[float, ...]:
        found = np.ones(CHANNELS)
        for i in rng.choice(CHANNELS, rng.integers(0, 3), replace=False):
            found[i] *= rng.choice([0.8, 1.2])
        for i in rng.choice(CHANNELS, rng.integers(0, 3), replace=False):
            found[i] *= -1.0
        return tuple(found.tolist())

    def maybe() -> int | None:
        return int(rng.integers(CHANNELS)) if rng.random() < 0.4 else None

    return Wiring(order(), scale(), order(), scale(), maybe(), maybe())


def mistakes(found: Commissioned, wiring: Wiring) -> list[str]:
    """Return what was not found, or found although it is not there."""
    wrong = []
    used = sensor_scale(found)
    usual = np.median([abs(s) for i, s in enumerate(wiring.coil_scale) if i != wiring.dead_coil])
    for i in range(CHANNELS):
        coil, sensor = found.coils.place[i], found.sensors.place[i]
        if coil != (-1 if i == wiring.dead_coil else wiring.coil_order[i]):
            wrong.append(f"coil {i} at {coil}")
        elif i != wiring.dead_coil:
            off = found.coils.gain[i] - wiring.coil_scale[i] / usual
            wrong += [f"gain of coil {i} off by {off:.3f}"] if abs(off) > COIL_OFF else []
        if sensor != (-1 if i == wiring.stuck_sensor else wiring.sensor_order[i]):
            wrong.append(f"sensor {i} at {sensor}")
        elif i != wiring.stuck_sensor:
            off = used[i] - wiring.sensor_scale[i]
            wrong += [f"scale of sensor {i} off by {off:.3f}"] if abs(off) > SENSOR_OFF else []
    named = problems(found)
    expected = (wiring.dead_coil is not None) + (wiring.stuck_sensor is not None)
    if len(named) != expected:
        wrong.append(f"said: {'; '.join(named)}")
    if wiring.right and (said := corrections(found)):
        wrong.append(f"corrected: {'; '.join(said)}")
    if found.largest_n > FORCE_N:
        wrong.append(f"a force of {found.largest_n} N")
    return wrong


def rig_file(folder: Path, kind: str, wiring: Wiring, seed: int) -> Path:
    """Write the shipped rig of a kind with a simulator of that wiring; return its path."""
    sim = yaml.safe_load(shipped("sims/nominal.yaml").read_text())
    sim |= {"seed": seed, "effects": [wiring.effect()]}
    (folder / "sim.yaml").write_text(yaml.safe_dump(sim))
    rig = yaml.safe_load(shipped(f"rigs/{kind}.yaml").read_text())
    rig |= {"sim": "sim.yaml", "model": str(shipped("models/rig.yaml"))}
    # Rights of the loop's process would be those of this benchmark from then on.
    rig["realtime"] = {"priority": 0, "lock_memory": False, "cpu_latency_us": None}
    if kind != "loopback":
        rig["rate_hz"] = BUS_RATE_HZ
    for number, bus in enumerate(rig.get("can", {}).values()):
        bus |= {"interface": "levid_local", "channel": str(folder / f"bus{number}")}
    for bus in rig.get("serial", {}).values():
        bus["port"] = str(folder / "port")
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(rig))
    return path


@contextlib.contextmanager
def emulated(path: Path) -> Iterator[Callable[[Hold], None]]:
    """Run `levid electronics` on a rig; yield the function that lets its hand lift."""
    process = subprocess.Popen(
        [sys.executable, "-m", "levid.cli.main", "electronics", str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    assert process.stdin is not None
    orders = process.stdin

    def lift(hold: Hold) -> None:
        orders.write(f"lift {hold}\n")
        orders.flush()

    try:
        if "emulating" not in process.stderr.readline():
            raise RuntimeError(process.stderr.read())
        yield lift
    finally:
        process.terminate()
        process.wait(_START_S)
        orders.close()
        process.stderr.close()


def commissioned(
    folder: Path, kind: str, wiring: Wiring, seed: int
) -> tuple[RigConfig, Commissioned]:
    """Commission a drawn rig of a kind."""
    path = rig_file(folder, kind, wiring, seed)
    rig = load_rig(path)
    context = Context(rig, 1.0 / rig.rate_hz, folder)

    def done(session: DeviceSession, ask: Callable[[Hold], None]) -> Commissioned:
        return commission(session, rig, STOPS, FORCE_N, ask, lambda *_: None)

    if kind == "loopback":
        with DeviceSession(context, FORCE_N, FORCE_N) as session:
            (backend,) = session.devices.backends
            assert isinstance(backend, LoopbackBackend)
            return rig, done(session, backend.lift)
    with emulated(path) as lift, DeviceSession(context, FORCE_N, FORCE_N) as session:
        return rig, done(session, lift)


def measure(quick: bool) -> Iterator[Figure]:
    """Commission all rigs; yield the shares that are right."""
    for kind, count in (
        ("loopback", 6 if quick else 120),
        *((k, 2 if quick else 60) for k in ("can", "serial")),
    ):
        right, alarms, good, longest_s = 0, 0, 0, 0.0
        for seed in range(FIRST_SEED, FIRST_SEED + count):
            wiring, begin_s = drawn(seed), time.monotonic()
            with tempfile.TemporaryDirectory() as folder:
                try:
                    _, found = commissioned(Path(folder), kind, wiring, seed)
                    wrong = mistakes(found, wiring)
                except Exception as error:  # noqa: BLE001 - counted, and the next rig goes on
                    wrong = [f"{type(error).__name__}: {error}"]
            longest_s = max(longest_s, time.monotonic() - begin_s)
            good += wiring.right
            alarms += wiring.right and bool(wrong)
            right += not wrong
            if wrong:
                print(f"{kind} {seed}: {'; '.join(wrong)}", file=sys.stderr)
        label = f"rigs on {kind}"
        yield Figure(
            f"right_{kind}",
            float(right),
            "1",
            f"{label} of {count} with all found",
            target=Target(least=count),
        )
        yield Figure(
            f"alarms_{kind}",
            float(alarms),
            "1",
            f"{label}, of {good} right ones with a false alarm",
            target=Target(most=0),
        )
        yield Figure(f"longest_s_{kind}", longest_s, "s", f"{label}, longest")


if __name__ == "__main__":
    benchmark_runner.run("Rigs with wrong wiring that are commissioned", measure)
