"""Cost of a cycle on each backend, its parts, how punctual 1 kHz on it is, and what flights give.

How punctual it is: _bus_lateness; sessions that are flown in real time, identified and compared
with loopback's: _bus_flights.
"""

from __future__ import annotations

import multiprocessing
import os
import pty
import select
import tempfile
import time
import tty
from collections.abc import Callable
from pathlib import Path

import _table
import cantools
import numpy as np
import serial
from _bus_flights import flight_figures
from _bus_lateness import lateness_figures
from _bus_rigs import (
    IN_ONE_PROCESS,
    RATE_HZ,
    TIMED,
    VIRTUAL,
    cycle_of,
    electronics_of,
    rig_on,
    rig_text,
)
from _table import Figure

from levid.config.shipped import shipped
from levid.drivers.base import Context
from levid.drivers.registry import open_devices
from levid.sim.electronics.rig import Electronics
from levid.wire.can_frames import load_frames
from levid.wire.serial_frames import Contents, SerialFrames
from levid.wire.stream import FrameStream

DBC = shipped("levid.dbc")


def measure(quick: bool) -> list[Figure]:
    n = 2_000 if quick else 20_000
    return [
        *codec_figures(n),
        *serial_figures(300 if quick else 3_000),
        *cycle_figures(500 if quick else 5_000),
        *lateness_figures(2.0 if quick else 10.0, 2 if quick else 12),
        *flown_figures(4.0 if quick else 20.0),
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
    for name in ("loopback", *IN_ONE_PROCESS):
        with tempfile.TemporaryDirectory() as folder:
            rig = rig_on(name, Path(folder), VIRTUAL)
            electronics = Electronics(rig, Path(folder)) if name in IN_ONE_PROCESS else None
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


def flown_figures(seconds: float) -> list[Figure]:
    """Sessions flown in real time over CAN FD, by both ways, and serial, against loopback's P."""
    with tempfile.TemporaryDirectory() as folder:
        rigs = {name: rig_text(name, Path(folder)) for name in ("loopback", *TIMED)}
        return flight_figures(rigs, electronics_of, seconds)


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
