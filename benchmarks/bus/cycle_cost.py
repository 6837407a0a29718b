"""What a cycle costs on each interface: to send its frames, to take those that came, and whole.

Sending and receiving are those of the driver's own end of the bus; the other end is in this
process, too, and not timed, and what is received has come by then: nothing is waited for. A whole
cycle, one each millisecond, is sync, all reads and writes of the three roles, and the wait for
electronics, which are a process of their own but on python-can's virtual bus, which stays in one.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import sys
import tempfile
import time
import tty
from collections.abc import Callable
from pathlib import Path

import numpy as np
from can import CanError

from levid.benchmarks.bus.bus_rigs import (
    APART,
    LABELS,
    RATE_HZ,
    cycle_of,
    electronics_on,
    opened,
    rig_on,
    rig_text,
)
from levid.benchmarks.bus.codecs import Cycle, frames_of
from levid.benchmarks.bus.serial_transaction import AXES, CONTENTS, FORCES_N, GAPS_M
from levid.benchmarks.harness import real_time
from levid.benchmarks.harness.table import Figure
from levid.config.buses import SerialBus
from levid.daemon.host.real_time_scheduling import no_collections
from levid.daemon.loop.clock import RealClock
from levid.drivers.base import DriverError
from levid.drivers.serial.serial_line import SerialLine
from levid.sim.electronics.emulated_rig import Electronics
from levid.wire.can.can_bus import FrameBus, open_bus
from levid.wire.can.can_frames import load_frames
from levid.wire.serial.serial_frames import SerialFrames

INTERFACES = ("can", "canfd", "canfd_udp", "canfd_virtual")
MOST_STALE = 0.1
"""Share of the cycles that may have been waited for in vain: with more there is no figure."""
_WARM_UP = 100
_COMES_S = 5.0


def interface_figures(n: int) -> list[Figure]:
    """Return the times of `n` cycles' frames on each interface of CAN and on a serial port."""
    figures: list[Figure] = []
    for name in (*INTERFACES, "serial"):
        with tempfile.TemporaryDirectory() as folder:
            times = _serial_times(n) if name == "serial" else _can_times(name, Path(folder), n)
        if not times:
            print(f"{LABELS[name]}: frames got lost again and again: no figure", file=sys.stderr)
            continue
        send_us, receive_us = 1e6 * np.median(times[_WARM_UP:], axis=0)
        who = LABELS[name]
        figures += [
            Figure(f"{name}_send_us", float(send_us), "us", f"{who}: send a cycle's frames"),
            Figure(f"{name}_receive_us", float(receive_us), "us", f"{who}: take what came"),
        ]
    return figures


def cycle_figures(n: int) -> list[Figure]:
    """Return the median time of a cycle on each backend, of those whose readings were all fresh."""
    figures: list[Figure] = []
    for name in ("loopback", *APART, "canfd_virtual"):
        where = {"loopback": "", "canfd_virtual": ", electronics in a thread"}
        label = f"{LABELS[name]}: a whole cycle{where.get(name, ', electronics apart')}"
        try:
            times, stale = _on_backend(name, n)
        except DriverError as error:
            print(f"{label}: no figure: {error}", file=sys.stderr)
            continue
        figures.append(Figure(f"{name}_cycle_stale", stale, "", f"{label}: of {n}, stale"))
        if stale <= MOST_STALE * n:
            figures.append(Figure(f"{name}_cycle_us", 1e6 * float(np.median(times)), "us", label))
        else:
            print(f"{label}: no figure: {stale} of {n} were stale", file=sys.stderr)
    return figures


def _on_backend(name: str, n: int) -> tuple[list[float], int]:
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        rig = rig_on(name, folder)
        if name in APART:
            path = folder / "rig.yaml"
            path.write_text(rig_text(name, folder))
            electronics = stack.enter_context(electronics_on(path))
        elif name != "loopback":
            stack.enter_context(Electronics(rig, folder))
        devices = stack.enter_context(opened(rig, folder))
        if name in APART:
            real_time.hurry(real_time.ELECTRONICS, electronics.pid)
            stack.callback(real_time.relax)
            real_time.hurry(real_time.LOOP)
        return _fresh_cycles(cycle_of(devices), n)


def _fresh_cycles(cycle: Callable[[int], bool], n: int) -> tuple[list[float], int]:
    """Return the times of the cycles that were answered, at 1 kHz, and how many were not."""
    times, stale, number = [], 0, 0
    clock = RealClock(1 / RATE_HZ)
    with no_collections():
        clock.start()
        for k in range(-_WARM_UP, n):
            clock.wait()
            number += 1 + clock.skipped
            start = time.perf_counter()
            fresh = cycle(number)
            took_s = time.perf_counter() - start
            if k < 0:
                continue
            if fresh:
                times.append(took_s)
            else:
                stale += 1
    return times, stale


def _can_times(name: str, folder: Path, n: int) -> list[tuple[float, float]]:
    """Return how long the frames of each cycle took to be sent, and to be received.

    Where the machine is busy udp_multicast does not get rid of a frame in time, now and then: that
    is no cycle. Nothing is returned where it is more than now and then.
    """
    bus = rig_on(name, folder).can["main"]
    cycle = frames_of(load_frames(None, 9, 9, bus.fd), FORCES_N, GAPS_M)
    times: list[tuple[float, float]] = []
    lost = 0
    with contextlib.ExitStack() as stack:
        ends: list[FrameBus] = []
        for _ in range(2):
            ends.append(open_bus(bus))
            stack.callback(ends[-1].shutdown)
        for end in reversed(ends):  # who joins is noticed with the next receive
            end.receive(0.1)
        while len(times) < _WARM_UP + n:
            try:
                times.append(_exchange(ends[0], ends[1], cycle))
            except CanError:
                lost += 1
                if lost > MOST_STALE * n:
                    return []
                for end in ends:
                    while end.receive(0.0) is not None:
                        pass
    return times


def _exchange(host: FrameBus, device: FrameBus, cycle: Cycle) -> tuple[float, float]:
    start = time.perf_counter()
    for can_id, data in cycle.sent:
        host.send(can_id, data)
    sent_s = time.perf_counter() - start
    _take(device, cycle.sent)
    for can_id, data in cycle.received:
        device.send(can_id, data)
    start = time.perf_counter()
    _take(host, cycle.received)
    return sent_s, time.perf_counter() - start


def _take(end: FrameBus, frames: list[tuple[int, bytes]]) -> None:
    """Receive until all of these have come; udp_multicast brings what was sent itself, too."""
    missing = dict(frames)
    give_up_s = time.perf_counter() + _COMES_S
    while missing:
        frame = end.receive(give_up_s - time.perf_counter())
        if frame is None:
            raise CanError(f"{len(missing)} frames did not come")
        if frame.can_id in missing:
            assert missing.pop(frame.can_id) == frame.data


def _serial_times(n: int) -> list[tuple[float, float]]:
    master, slave = pty.openpty()
    tty.setraw(slave)
    line = SerialLine("bench", SerialBus(port=os.ttyname(slave), baud=3_000_000))
    frames, still = SerialFrames(CONTENTS), np.zeros(3)
    setpoints = frames.cycle(1, FORCES_N, still, still)
    readings = frames.readings(1, (1, FORCES_N), (0, GAPS_M), (2, 0, AXES))
    times = []
    try:
        line.open()
        for _ in range(_WARM_UP + n):
            start = time.perf_counter()
            line.write(setpoints)
            sent_s = time.perf_counter() - start
            assert _all_of(lambda: _read(master), len(setpoints)) == setpoints
            os.write(master, readings)
            start = time.perf_counter()
            came = _all_of(lambda: line.read(time.perf_counter() + _COMES_S), len(readings))
            times.append((sent_s, time.perf_counter() - start))
            assert came == readings
    finally:
        line.close()
        os.close(master)
        os.close(slave)
    return times


def _read(fd: int) -> bytes:
    return os.read(fd, 4096) if select.select([fd], (), (), _COMES_S)[0] else b""


def _all_of(read: Callable[[], bytes], length: int) -> bytes:
    data = b""
    while len(data) < length:
        more = read()
        assert more, f"{length - len(data)} bytes did not come"
        data += more
    return data
