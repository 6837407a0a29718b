"""Errors of buses and ports that cannot be opened, or on which no device answers, say what to do.

Every error is provoked: a missing or shut-down network interface, ports without file, access or
device. The kernel's CAN is tested as far as this machine has it; tests/rig_vm has all of it.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from levid.config.buses import CanBus, SerialBus
from levid.drivers import remedies
from levid.drivers.base import LinkError
from levid.drivers.can.bus_link import CanLink
from levid.drivers.serial.serial_line import SerialLine


def error_of(action: Callable[[], object]) -> str:
    with pytest.raises(LinkError) as raised:
        action()
    message = str(raised.value)
    assert "Errno" not in message
    return message


def can(**keys: object) -> CanLink:
    return CanLink("main", CanBus.model_validate(keys))


def serial(port: object, baud: int = 115_200) -> SerialLine:
    return SerialLine("main", SerialBus(port=str(port), baud=baud))


def test_missing_network_interface() -> None:
    message = error_of(can(interface="socketcan", channel="can77").open)
    assert message == (
        "can main (socketcan can77): cannot be opened: no network interface can77: connect the CAN "
        "adapter and load its driver; `ip link` lists the interfaces"
    )
    assert "sudo ip link add dev vcan77 type vcan" in error_of(
        can(interface="socketcan", channel="vcan77").open
    )


@pytest.mark.parametrize(
    ("more", "command"),
    [
        ({}, "up txqueuelen 64 type can bitrate 500000 restart-ms 100"),
        (
            {"data_bitrate": 4_000_000},
            "up txqueuelen 64 type can bitrate 500000 dbitrate 4000000 fd on restart-ms 100",
        ),
    ],
)
def test_network_interface_that_is_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: dict[str, int], command: str
) -> None:
    (tmp_path / "can0").mkdir()
    flags = tmp_path / "can0" / "flags"
    flags.write_text("0x40080\n")
    monkeypatch.setattr(remedies, "NETWORKS", tmp_path)
    bus = CanBus.model_validate(
        {"interface": "socketcan", "channel": "can0", "bitrate": 500_000, **more}
    )
    problem = f"network interface can0 is down: bring it up: sudo ip link set can0 {command}"
    assert remedies.network_problem(bus) == problem
    assert remedies.can_problem(bus, OSError(errno.ENETDOWN, "Network is down")) == problem
    flags.write_text("0x40081\n")
    assert remedies.network_problem(bus) == ""


def test_bus_without_acknowledgement_and_kernel_without_can() -> None:
    bus = CanBus(interface="socketcan", channel="can0")
    full = remedies.can_problem(bus, OSError(errno.ENOBUFS, "No buffer space available"))
    assert "check power, wiring, termination and bit rate" in full
    no_can = OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")
    assert "sudo modprobe can_raw" in remedies.can_problem(bus, no_can)


def test_silent_devices() -> None:
    between_programs = CanBus(interface="udp_multicast", channel="239.74.163.2")
    assert "`levid electronics RIG.yaml`" in remedies.no_can_answer(between_programs)
    hardware = CanBus(interface="pcan", channel="PCAN_USBBUS1", bitrate=250_000)
    assert "bit rate (250000 bit/s in RIG.yaml)" in remedies.no_can_answer(hardware)
    assert "baud rate (9600 Bd in RIG.yaml)" in remedies.no_serial_answer("/dev/ttyUSB9", 9600)


def test_missing_port() -> None:
    assert error_of(serial("/dev/ttyUSB77").open).endswith(
        "no port /dev/ttyUSB77: connect the adapter; `ls /dev/serial/by-id` lists the connected "
        "ones"
    )


def test_missing_port_of_the_emulated_electronics(tmp_path: Path) -> None:
    assert error_of(serial(tmp_path / "port").open).endswith(
        f"no port {tmp_path / 'port'}: start `levid electronics RIG.yaml` in another terminal"
    )


def test_file_that_is_not_a_port(tmp_path: Path) -> None:
    (tmp_path / "port").touch()
    message = error_of(serial(tmp_path / "port").open)
    assert "not a serial port: correct `port` in RIG.yaml" in message


@pytest.fixture
def terminal() -> Iterator[str]:
    ours, theirs = os.openpty()
    yield os.ttyname(theirs)
    os.close(ours)
    os.close(theirs)


def test_port_that_another_program_uses(terminal: str) -> None:
    line = serial(terminal)
    line.open()
    message = error_of(serial(terminal).open)
    line.close()
    assert f"another program uses this port: end it; `fuser {terminal}`" in message


def test_port_at_whose_other_end_no_electronics_answer(terminal: str) -> None:
    assert "`levid electronics RIG.yaml`" in remedies.no_serial_answer(terminal, 9600)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can change its user")
@pytest.mark.parametrize(
    ("group", "mode", "remedy"),
    [
        (20, 0o660, "sudo usermod --append --groups dialout $USER, then log out and in again"),
        (0, 0o600, "sudo chgrp dialout {0}; sudo chmod g+rw {0}"),
    ],
)
def test_port_without_access(terminal: str, group: int, mode: int, remedy: str) -> None:
    os.chown(terminal, 0, group)
    Path(terminal).chmod(mode)
    os.seteuid(65_534)
    try:
        message = error_of(serial(terminal).open)
    finally:
        os.seteuid(0)
    assert f"this user may not open {terminal}: " in message
    assert message.endswith(remedy.format(terminal))


def test_device_server_that_does_not_run() -> None:
    message = error_of(serial("socket://127.0.0.1:1").open)
    assert "Connection refused: check the address" in message
