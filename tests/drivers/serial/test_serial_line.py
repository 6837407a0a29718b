"""A port at any URL: opened or refused with a clear error, read up to a deadline and no further."""

from __future__ import annotations

import contextlib
import io
import os
import select
import socket
import threading
import time
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import serial
from bus_lock_checks import is_for_one_loop
from serial import rfc2217

from levid.config.buses import SerialBus
from levid.config.rig import RigConfig
from levid.drivers.base import Context, DriverError, LinkError, StaleError
from levid.drivers.bus_backend import AnswerTime
from levid.drivers.open_backends import open_devices
from levid.drivers.serial.serial_line import SerialLine
from levid.drivers.serial.transaction import TransactionPort
from levid.sim.electronics.emulated_rig import Electronics
from levid.wire.device_protocol import CYCLES
from levid.wire.frame_rejection_reasons import Rejected
from levid.wire.serial.serial_frames import FrameContents, SerialFrames

RATE_HZ = 50.0


class Manager(rfc2217.PortManager):
    """A pseudo terminal has no modem lines."""

    def check_modem_lines(self, force_notification: bool = False) -> None:
        return


class Server:
    """Serve a pseudo terminal by RFC 2217."""

    def __init__(self, path: Path) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"rfc2217://127.0.0.1:{self._listener.getsockname()[1]}"
        self._path, self._stopping = path, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        self._listener.close()

    def _run(self) -> None:
        while not self._stopping.is_set():
            if not select.select([self._listener], [], [], 0.05)[0]:
                continue
            client, _ = self._listener.accept()
            end = os.open(self._path, os.O_RDWR | os.O_NOCTTY)
            with contextlib.closing(client), contextlib.suppress(OSError):
                self._serve(client, end)
            os.close(end)

    def _serve(self, client: socket.socket, end: int) -> None:
        settings = MagicMock(baudrate=3_000_000, bytesize=8, parity="N", stopbits=1)
        manager = Manager(settings, MagicMock(write=client.sendall))
        while not self._stopping.is_set():
            ready, _, _ = select.select([client, end], [], [], 0.05)
            if client in ready:
                data = client.recv(4096)
                if not data:
                    return
                os.write(end, b"".join(manager.filter(data)))
            if end in ready:
                client.sendall(b"".join(manager.escape(os.read(end, 4096))))


@pytest.mark.filterwarnings("ignore:setDaemon:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:setName:DeprecationWarning")
@pytest.mark.usefixtures("host_paced")
def test_rig_is_driven_over_rfc2217(rig_on, quiet_sim: Path, tmp_path: Path) -> None:
    here = rig_on("serial", RATE_HZ, quiet_sim)
    with Electronics(here, tmp_path), contextlib.closing(Server(tmp_path / "port")) as server:
        bus = here.serial["main"].model_copy(update={"port": server.url})
        rig: RigConfig = here.model_copy(update={"serial": {"main": bus}})
        devices = open_devices(Context(rig, 1 / RATE_HZ, tmp_path))
        gap, coil, beam, rotor = np.zeros(9), np.zeros(9), np.zeros(3), np.zeros(3)
        for k in range(40):
            devices.sync(k)
            devices.sensors.read(gap)
            devices.drives.read(beam, rotor)
            devices.amplifiers.read(coil)
            devices.amplifiers.write(np.full(9, 7.0 if k > 30 else 0.0))
        assert devices.stale == 0
        assert coil == pytest.approx(7.0, abs=2e-3)
        devices.close()


@pytest.mark.usefixtures("host_paced")
def test_limits_of_the_rotor_are_compared_too(rig_on, quiet_sim: Path, tmp_path: Path) -> None:
    rig = rig_on("serial", RATE_HZ, quiet_sim)
    slower = rig.limits.model_copy(update={"rotor_velocity_rad_s": 10.0})
    words = "ROTOR_SPEED_MRAD_S: expected 20000, found 10000"
    with (
        Electronics(rig.model_copy(update={"limits": slower}), tmp_path),
        pytest.raises(DriverError, match=words),
    ):
        open_devices(Context(rig, 1 / RATE_HZ, tmp_path))


@pytest.mark.parametrize("url", ["rfc2217://127.0.0.1:1", "nonsense://x", "/nowhere/port"])
def test_port_that_cannot_be_opened_is_a_lost_link(url: str) -> None:
    line = SerialLine("main", SerialBus(port=url, baud=115_200))
    with pytest.raises(LinkError, match=f"serial main .{url}.: cannot be opened: "):
        line.open()


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The ports that pyserial has opened."""
    opened, open_url = [], serial.serial_for_url

    def noted(*arguments: Any, **options: Any) -> Any:
        opened.append(open_url(*arguments, **options))
        return opened[-1]

    monkeypatch.setattr(serial, "serial_for_url", noted)
    return opened


def test_port_over_tcp_sends_at_once(opened: list[Any]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"socket://127.0.0.1:{server.getsockname()[1]}"
        line = SerialLine("main", SerialBus(port=url, baud=115_200))
        line.open()
        assert opened[0]._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        line.close()


def test_second_loop_on_a_tcp_device_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        bus = SerialBus(port=f"socket://127.0.0.1:{server.getsockname()[1]}", baud=115_200)
        is_for_one_loop(SerialLine("main", bus), SerialLine("main", bus))


def test_lost_port_is_closed_after_the_cycle(opened: list[Any]) -> None:
    """pyserial sleeps 0.3 s when it closes a TCP port; other ports still need zero force."""
    took_s = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"socket://127.0.0.1:{server.getsockname()[1]}"
        line = SerialLine("main", SerialBus(port=url, baud=115_200))
        for _ in range(2):
            line.open()
            lost = opened[-1]
            server.accept()[0].close()
            began_s = time.perf_counter()
            with pytest.raises(LinkError, match="closed by the other end"):
                line.read(began_s + 10.0)
            took_s.append(time.perf_counter() - began_s)
            with pytest.raises(LinkError, match="not open"):
                line.write(b"x")
            assert lost.is_open
        line.close()
        assert not lost.is_open
    assert min(took_s) < 0.25


def test_port_without_a_descriptor_is_read_up_to_the_deadline(opened: list[Any]) -> None:
    line = SerialLine("main", SerialBus(port="loop://", baud=3_000_000))
    line.open()
    with pytest.raises(io.UnsupportedOperation):
        opened[0].fileno()
    assert line.read(0.0) == b""
    began_s = time.perf_counter()
    assert line.read(began_s + 0.02) == b""
    assert time.perf_counter() >= began_s + 0.02
    line.write(b"abc")
    assert line.read(time.perf_counter() + 10.0) == b"abc"
    line.close()


CONTENTS = FrameContents(9, 9, False)


class Babble:
    """A line on which bytes always arrive."""

    def __init__(self, data: bytes) -> None:
        self.data, self.last = data, b""

    def read(self, _: float) -> bytes:
        last, self.last = self.last, b""
        return last or self.data

    def write(self, _: bytes) -> None:
        return


def port_on(babble: Babble, wait_s: float) -> TransactionPort:
    bus = SerialBus(port="loop://", baud=3_000_000, stale_cycles=1000)
    line: Any = babble
    return TransactionPort("main", bus, CONTENTS, AnswerTime(wait_s), line)


def readings(cycle: int) -> bytes:
    frames, zeros = SerialFrames(CONTENTS), np.zeros(9)
    return frames.readings(cycle % CYCLES, (1, zeros), (0, zeros), (0, 0, np.zeros((3, 3))))


def rejected(port: TransactionPort) -> str:
    """Return the reasons that a port reports once no clean reading comes any more."""
    with pytest.raises(StaleError) as error:  # noqa: PT012
        for _ in range(2000):
            port.watch.begin()
            port.watch.missing()
    return str(error.value).partition("received: ")[2]


def test_wait_ends_at_its_deadline_on_a_babbling_line() -> None:
    port = port_on(Babble(b"\x01\x00"), 0.01)
    port.sync(0)
    port.collect()  # it must return
    assert not port.fresh


def test_missing_answer_to_immediate_setpoints_is_forgotten_after_its_cycle() -> None:
    """An answer that was lost must not make a repeated reading of a later cycle count."""
    line = Babble(b"")
    port = port_on(line, 0.01)
    port.sync(0)
    port.send_setpoints()  # its answer is lost
    port.collect()
    port.sync(1)
    line.last = readings(1) + readings(1)
    port.collect()
    assert port.fresh
    assert rejected(port) == f"1 frames {Rejected.REPEATED.value}"


def test_overlong_block_makes_a_cycle_unclean() -> None:
    line = Babble(b"")
    port = port_on(line, 0.01)
    port.sync(0)
    line.last = b"\x01" * 1000 + b"\0" + readings(0)
    port.collect()
    assert port.fresh
    assert rejected(port) == f"1 frames {Rejected.FRAMING.value}"


def test_full_send_buffer_is_a_lost_link_at_once(
    opened: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other end reads nothing: the cycle does not wait for room."""
    master, slave = os.openpty()
    line = SerialLine("main", SerialBus(port=os.ttyname(slave), baud=3_000_000))

    def fill() -> None:
        for _ in range(10_000):
            line.write(b"x" * 100)

    try:
        line.open()
        patient = MagicMock()
        monkeypatch.setattr(opened[0], "write", patient)
        with pytest.raises(LinkError, match=r"buffer full|unavailable"):
            fill()
        assert not patient.called  # pyserial would wait for 0.1 s
    finally:
        os.close(master)
        os.close(slave)
