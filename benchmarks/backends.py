"""Cost of a cycle on each backend, its parts, and how punctual 1 kHz on it is.

`late` compares whole loops with an empty timed one, in turns in the same run: the share of cycles
that are late by a period, and the upper end of the 95 % interval of the ratio. Sessions flown in
real time are identified and compared with loopback's: see _bus_flights.
"""

from __future__ import annotations

import multiprocessing
import os
import pty
import select
import subprocess
import sys
import tempfile
import time
import tty
from collections.abc import Callable
from pathlib import Path

import _real_time
import _table
import cantools
import numpy as np
import serial
from _bus_flights import flight_figures
from _shares import ratio_95
from _table import Figure

from levid.config.base import parse_text
from levid.config.rig import RigConfig
from levid.config.service import Realtime
from levid.config.shipped import shipped
from levid.daemon.clock import RealClock
from levid.daemon.realtime import be_punctual
from levid.drivers.base import Context, Devices
from levid.drivers.registry import open_devices
from levid.sim.electronics.rig import Electronics
from levid.wire.can_frames import load_frames
from levid.wire.serial_frames import Contents, SerialFrames
from levid.wire.stream import FrameStream

RATE_HZ = 1000.0
UDP = ("udp_multicast", "239.74.163.17")
DBC = shipped("levid.dbc")
HEAD = shipped("rigs/loopback.yaml").read_text().partition("amplifiers:")[0]
CAN = "{backend: can, bus: main"
SERIAL = "{backend: serial, bus: main"
BUSES = {
    "can": (  # two buses: one classic one does not carry 1 kHz
        "can: {main: {interface: INTERFACE, channel: CHANNEL, stale_cycles: 1000}, "
        "motion: {interface: INTERFACE, channel: CHANNEL-2, stale_cycles: 1000}}",
        CAN,
    ),
    "canfd": (
        "can: {main: {interface: INTERFACE, channel: CHANNEL, data_bitrate: 5000000, "
        "stale_cycles: 1000}}",
        CAN,
    ),
    "serial": ("serial: {main: {port: FOLDER/port, baud: 3000000, stale_cycles: 1000}}", SERIAL),
}


def measure(quick: bool) -> list[Figure]:
    n = 2_000 if quick else 20_000
    return [
        *codec_figures(n),
        *serial_figures(300 if quick else 3_000),
        *cycle_figures(500 if quick else 5_000),
        *late_figures(2.0 if quick else 10.0, 2 if quick else 6),
        *flight_figures(
            {
                name: rig_text(name, Path(tempfile.gettempdir()) / "levid-flights", *UDP)
                for name in ("loopback", "canfd", "serial")
            },
            _electronics,
            4.0 if quick else 20.0,
        ),
    ]


def codec_figures(n: int) -> list[Figure]:
    """Encode and decode all frames of a cycle, against cantools, which knows no checksum."""
    database = cantools.database.load_file(str(DBC))
    values = np.random.default_rng(1).uniform(-9e-4, 9e-4, 9)
    out = np.zeros(9)
    figures = []
    for fd, name in ((False, "can"), (True, "canfd")):
        frames = load_frames(None, 9, 9, fd)
        gap, force, setpoint = frames.gap, frames.force, frames.setpoint
        answers = [(g, g.encode(values, 5, 0)) for g in (gap, force)]
        sent = [*setpoint.encode(values, 5, 0), frames.sync.encode(5)]
        messages = [database.get_message_by_frame_id(i) for i, _ in sent]
        signals = [
            m.decode(d, decode_choices=False) for m, (_, d) in zip(messages, sent, strict=True)
        ]
        received = [
            (database.get_message_by_frame_id(i), d) for _, batch in answers for i, d in batch
        ]

        def levid_encode(frames=frames, setpoint=setpoint) -> None:  # type: ignore[no-untyped-def]
            frames.sync.encode(5)
            setpoint.encode(values, 5, 0)

        def levid_decode(answers=answers) -> None:  # type: ignore[no-untyped-def]
            for group, batch in answers:
                group.begin()
                for can_id, data in batch:
                    group.accept(can_id, data, 5)
                group.finish(out)

        def cantools_encode(messages=messages, signals=signals) -> None:  # type: ignore[no-untyped-def]
            for message, numbers in zip(messages, signals, strict=True):
                message.encode(numbers)

        def cantools_decode(received=received) -> None:  # type: ignore[no-untyped-def]
            for message, data in received:
                message.decode(data, decode_choices=False)

        us = _in_turns(
            {
                "encode": levid_encode,
                "decode": levid_decode,
                "cantools_encode": cantools_encode,
                "cantools_decode": cantools_decode,
            },
            n,
        )
        ours, theirs = us["encode"] + us["decode"], us["cantools_encode"] + us["cantools_decode"]
        label = "CAN FD" if fd else "classic CAN"
        figures += [
            Figure(f"{name}_encode_us", us["encode"], "us", f"{label}: encode a cycle"),
            Figure(f"{name}_decode_us", us["decode"], "us", f"{label}: decode and check a cycle"),
            Figure(f"{name}_codec_us", ours, "us", f"{label}: both"),
            Figure(
                f"{name}_cantools_us",
                theirs,
                "us",
                f"{label}: both, cantools, no checks",
                f"{name}_codec_us",
            ),
        ]
    return figures


def serial_figures(n: int) -> list[Figure]:
    """A whole transaction over a pseudo terminal, against pyserial's read_until."""
    contents = Contents(9, 9, False)
    device, host = SerialFrames(contents), SerialFrames(contents)
    zero, axes = np.zeros(9), np.zeros((3, 3))
    master, slave = pty.openpty()
    tty.setraw(slave)
    port = serial.Serial(os.ttyname(slave), 3_000_000, timeout=1)

    def answer() -> None:
        stream = FrameStream(device.longest)
        while True:
            for block in stream.feed(os.read(master, 4096)):
                device.accept(block)
                os.write(master, device.readings(1, (1, zero), (0, zero), (0, 0, axes)))

    # A process of its own: a thread of this one would make whoever reads byte by byte wait for it.
    answering = multiprocessing.get_context("fork").Process(target=answer, daemon=True)
    answering.start()
    poll = select.poll()
    poll.register(port.fileno(), select.POLLIN)
    stream = FrameStream(host.longest)

    def ours() -> None:
        os.write(port.fileno(), host.cycle(1, zero, zero, zero))
        while True:
            poll.poll(1000)
            blocks = stream.feed(os.read(port.fileno(), 4096))
            if blocks:
                host.accept(blocks[0])
                return

    def theirs() -> None:
        port.write(host.cycle(1, zero, zero, zero))
        host.accept(port.read_until(b"\0")[:-1])

    us = _in_turns({"ours": ours, "theirs": theirs}, n // 5)
    readings = device.readings(1, (1, zero), (0, zero), (0, 0, axes))[:-1]
    parts = _in_turns(
        {
            "encode": lambda: host.cycle(1, zero, zero, zero),
            "decode": lambda: host.accept(readings),
        },
        10 * n,
    )
    answering.terminate()
    answering.join()
    port.close()
    os.close(master)
    return [
        Figure("serial_encode_us", parts["encode"], "us", "serial: encode a cycle"),
        Figure("serial_decode_us", parts["decode"], "us", "serial: decode and check a cycle"),
        Figure("serial_transaction_us", us["ours"], "us", "serial: transaction over a pty"),
        Figure(
            "serial_read_until_us",
            us["theirs"],
            "us",
            "serial: the same with pyserial's read_until",
            "serial_transaction_us",
        ),
    ]


def cycle_figures(n: int) -> list[Figure]:
    """Sync, all reads and writes of the three roles; electronics in a thread of this process."""
    figures = []
    for name in ("loopback", *BUSES):
        with tempfile.TemporaryDirectory() as folder:
            rig = rig_on(name, Path(folder), "virtual", "bench")
            electronics = Electronics(rig, Path(folder)) if name in BUSES else None
            if electronics is not None:
                electronics.__enter__()
            devices = open_devices(Context(rig, 1 / RATE_HZ, Path(folder)))
            cycle = cycle_of(devices)
            times = []
            for k in range(n):
                start = time.perf_counter()
                cycle(k)
                times.append(time.perf_counter() - start)
            devices.close()
            if electronics is not None:
                electronics.__exit__()
        label = f"{name}: a whole cycle, electronics included"
        figures.append(Figure(f"{name}_cycle_us", 1e6 * float(np.median(times)), "us", label))
    return figures


def late_figures(seconds: float, rounds: int) -> list[Figure]:
    """Timed loops at 1 kHz in turns: empty, CAN FD on udp_multicast, serial on a pty.

    Loops and electronics run at real-time priority where that may be had, the empty one too.
    """
    late = {"empty": 0, "canfd": 0, "serial": 0}
    cycles = dict.fromkeys(late, 0)
    stale = dict.fromkeys(late, 0)
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        started = []
        devices: dict[str, Devices] = {}
        try:
            for name in ("canfd", "serial"):
                rig = rig_on(name, folder, *UDP)
                path = folder / f"{name}.yaml"
                path.write_text(rig_text(name, folder, *UDP))
                started.append(_electronics(path))
                devices[name] = _opened(rig, folder)
                _real_time.hurry(_real_time.ELECTRONICS, started[-1].pid)
            _real_time.hurry(_real_time.LOOP)
            loops: dict[str, Callable[[int], None]] = {"empty": lambda _: None}
            loops |= {name: cycle_of(found) for name, found in devices.items()}
            begin = 0
            for _ in range(rounds):
                for name, loop in loops.items():
                    before = devices[name].stale if name in devices else 0
                    n, missed = _timed(loop, seconds, begin)
                    begin += n + missed + 1000
                    cycles[name] += n
                    late[name] += missed
                    if name in devices:
                        stale[name] += devices[name].stale - before
        finally:
            _real_time.relax()
            for found in devices.values():
                found.close()
            for process in started:
                process.terminate()
                process.wait()
    figures = [
        Figure(
            "empty_late_share",
            late["empty"] / cycles["empty"],
            "",
            f"empty loop at 1 kHz, {cycles['empty']} cycles: late share",
        )
    ]
    for name in ("canfd", "serial"):
        figures += [
            Figure(
                f"{name}_late_share",
                late[name] / cycles[name],
                "",
                f"{name}: late share",
                "empty_late_share" if late["empty"] else None,
            ),
            Figure(
                f"{name}_late_ratio_95",
                ratio_95(late[name], cycles[name], late["empty"], cycles["empty"])[1],
                "",
                f"{name}: ratio of late shares, 95 % bound",
            ),
            Figure(
                f"{name}_stale_share", stale[name] / cycles[name], "", f"{name}: stale readings"
            ),
        ]
    return figures


def rig_text(name: str, folder: Path, interface: str, channel: str) -> str:
    """Return the text of the shipped rig with every role on this backend."""
    if name == "loopback":
        return f"""{HEAD}
amplifiers: {{backend: loopback}}
sensors: {{backend: loopback}}
drives: {{backend: loopback}}
sim: {shipped("sims/nominal.yaml")}
"""
    buses, role = BUSES[name]
    if interface == "udp_multicast":
        # Its own: a kernel hands frames of any group to all sockets of a port.
        port = 20_000 + os.getpid() % 20_000
        buses = buses.replace("CHANNEL", f"CHANNEL, options: {{port: {port}}}")
    buses = buses.replace("INTERFACE", interface).replace("CHANNEL", channel)
    every = ", every: 4, expire_s: 60" if name != "serial" else ""
    other = role.replace("main", "motion") if name == "can" else role
    return f"""{HEAD}
{buses.replace("FOLDER", str(folder))}
amplifiers: {role}, expire_cycles: 1000}}
sensors: {other}}}
drives: {other}{every}}}
sim: {shipped("sims/nominal.yaml")}
"""


def rig_on(name: str, folder: Path, interface: str, channel: str) -> RigConfig:
    """Return that rig."""
    return parse_text(rig_text(name, folder, interface, channel), RigConfig, name)


def cycle_of(devices: Devices) -> Callable[[int], None]:
    """Return what the loop does with devices in a cycle, at zero force."""
    gap, force, zero = np.zeros(9), np.zeros(9), np.zeros(9)
    beam, rotor, still = np.zeros(3), np.zeros(3), np.zeros(3)

    def cycle(k: int) -> None:
        for sync in devices.syncs:
            sync(k)
        devices.sensors.read(gap)
        devices.drives.read(beam, rotor)
        devices.amplifiers.read(force)
        devices.amplifiers.write(zero)
        devices.drives.write(still, still)

    return cycle


def _timed(loop: Callable[[int], None], seconds: float, begin: int) -> tuple[int, int]:
    """Run `loop` at 1 kHz; return cycles run and how many of them were late by a period."""
    be_punctual(Realtime(priority=0, lock_memory=False, cpu_latency_us=None))
    clock = RealClock(1 / RATE_HZ)
    clock.start()
    cycle, late = begin, 0
    n = int(seconds * RATE_HZ)
    for _ in range(n):
        clock.wait()
        cycle += 1 + clock.skipped
        late += clock.skipped > 0
        loop(cycle)
    return n, late


def _electronics(rig_file: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "levid.cli.main", "electronics", str(rig_file)],
        stdin=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def _opened(rig: RigConfig, folder: Path) -> Devices:
    """Open devices once their electronics, which are just being started, answer."""
    give_up_s = time.monotonic() + 30.0
    while True:
        try:
            return open_devices(Context(rig, 1 / RATE_HZ, folder))
        except Exception:
            if time.monotonic() > give_up_s:
                raise
            time.sleep(0.2)


def _in_turns(contenders: dict[str, Callable[[], object]], n: int) -> dict[str, float]:
    """Return the median time of a call in us; they take turns in five rounds."""

    def batch(call: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            for _ in range(n):
                call()

        return run

    found = _table.median_times({name: batch(call) for name, call in contenders.items()}, 5)
    return {name: 1e6 * seconds / n for name, seconds in found.items()}


if __name__ == "__main__":
    _table.run("Backends", measure)
