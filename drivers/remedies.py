"""Explain why a CAN bus or a serial port cannot be used, and what to do."""

from __future__ import annotations

import errno
import grp
import os
import re
import stat
from pathlib import Path

from ..config.buses import CanBus

NETWORKS = Path("/sys/class/net")
_IS_UP = 0x1
_BETWEEN_PROGRAMS = ("virtual", "udp_multicast", "levid_local")
BUS_OFF = "check wiring and termination, and that all devices have the same bit rate"
_EMULATE = "start `levid electronics RIG.yaml` in another terminal"
_PSEUDO_TERMINALS = Path("/dev/pts")


def has_no_hardware(bus: CanBus) -> bool:
    """Return whether only programs can be on the bus, or whether it is the kernel's own (vcan)."""
    if bus.interface == "socketcan":
        network = NETWORKS / str(bus.channel)
        return network.exists() and not (network / "device").exists()
    return bus.interface in _BETWEEN_PROGRAMS


def is_pseudo_terminal(port: str) -> bool:
    """Return whether the port exists and a program is at its other end."""
    path = Path(port)
    return path.exists() and path.resolve().is_relative_to(_PSEUDO_TERMINALS)


def network_problem(bus: CanBus) -> str:
    """Return whether the network interface of a bus is missing or down; empty if it is up."""
    if bus.interface != "socketcan":
        return ""
    name, network = str(bus.channel), NETWORKS / str(bus.channel)
    if not network.exists():
        how = "connect the CAN adapter and load its driver; `ip link` lists the interfaces"
        if name.startswith("vcan"):
            how = f"create it: sudo ip link add dev {name} type vcan; sudo ip link set {name} up"
        return f"no network interface {name}: {how}"
    try:
        flags = int((network / "flags").read_text(), 16)
    except OSError:  # just removed
        return ""
    return "" if flags & _IS_UP else f"network interface {name} is down: {bring_up(bus)}"


def bring_up(bus: CanBus) -> str:
    """Return the command that brings up the network interface of a bus with its bit rates."""
    name = str(bus.channel)
    if name.startswith("vcan"):
        return f"bring it up: sudo ip link set {name} up"
    fd = f" dbitrate {bus.data_bitrate} fd on" if bus.fd else ""
    return (
        f"bring it up: sudo ip link set {name} up txqueuelen 64 type can bitrate {bus.bitrate}{fd} "
        "restart-ms 100"
    )


def can_problem(bus: CanBus, error: Exception) -> str:
    """Return why opening or using a CAN bus failed, with a remedy where the cause is known."""
    text = str(error) or type(error).__name__  # timeouts of python-can have no text
    if bus.interface == "socketcan":
        return _socketcan_problem(bus, _number(error)) or text
    if bus.interface == "slcan":  # the channel may be followed by @ and a baud rate
        return port_problem(str(bus.channel).partition("@")[0]) or text
    if bus.interface == "udp_multicast" and _number(error) in (errno.ENODEV, errno.ENETUNREACH):
        return (
            "this machine has no route for multicast: connect it to a network, or run sudo ip link "
            "set lo up; sudo ip route add 224.0.0.0/4 dev lo"
        )
    return text


def _socketcan_problem(bus: CanBus, number: int | None) -> str:
    """Return what an error number of the kernel's CAN means; empty if it is none of these."""
    match number:
        case errno.EAFNOSUPPORT:
            return "this kernel has no CAN: load its module: sudo modprobe can_raw"
        case errno.ENETDOWN:
            return f"network interface {bus.channel} is down: {bring_up(bus)}"
        case errno.ENOBUFS:
            return (
                "the send queue is full, because no device acknowledges the frames: check power, "
                "wiring, termination and bit rate"
            )
        case errno.ENODEV | errno.ENXIO:
            return network_problem(bus)
    return ""


def no_can_answer(bus: CanBus) -> str:
    """Return what to do if no device answers on a bus."""
    if has_no_hardware(bus):
        return f"{_EMULATE}, or end and start it again"
    rate = f"bit rate ({bus.bitrate} bit/s in RIG.yaml)"
    return f"check power, wiring, termination and {rate} of the devices"


def port_problem(port: str) -> str:
    """Return why a serial port cannot be used, with a remedy; empty if it can, or for a URL."""
    path = Path(port)
    if "://" in port or os.access(path, os.R_OK | os.W_OK, effective_ids=True):
        return ""
    if not path.exists():
        if path.is_relative_to("/dev"):
            how = "connect the adapter; `ls /dev/serial/by-id` lists the connected ones"
        else:
            how = _EMULATE
        return f"no port {port}: {how}"
    return f"this user may not open {port}: {_join_group(path)}"


def serial_problem(port: str, baud: int, error: Exception) -> str:
    """Return why opening a serial port failed, with a remedy where the cause is known."""
    if problem := port_problem(port):
        return problem
    text = str(error)
    # pyserial wraps the errors of a port's lock and of an unknown rate in its own, as text.
    if "exclusively lock" in text or _number(error) == errno.EBUSY:
        return f"another program uses this port: end it; `fuser {port}` prints its process number"
    if "baud" in text:
        return f"the port has no rate of {baud} Bd: expected a rate of the adapter as `baud`"
    if "://" not in port and not _is_terminal(Path(port)):
        return "this is not a serial port: correct `port` in RIG.yaml"
    if "://" in port:
        text = re.sub(r"\[Errno \d+\] ", "", text)
        return f"{text}: check the address, and that the device server runs"
    return text


def no_serial_answer(port: str, baud: int) -> str:
    """Return what to do if no device answers on a port."""
    if is_pseudo_terminal(port):
        return f"{_EMULATE}, or end and start it again"
    return f"check power, wiring and baud rate ({baud} Bd in RIG.yaml) of the device"


def _join_group(port: Path) -> str:
    """Return how this user gets access to a port, as a member of the port's group."""
    found = port.stat()
    shared = stat.S_IRGRP | stat.S_IWGRP
    try:
        group = grp.getgrgid(found.st_gid).gr_name
    except KeyError:
        group = str(found.st_gid)
    if found.st_gid == 0 or found.st_mode & shared != shared:
        group = "dialout"  # the group of serial ports on Debian; udev gives it to new ports
        return f"give its group access: sudo chgrp {group} {port}; sudo chmod g+rw {port}"
    return f"sudo usermod --append --groups {group} $USER, then log out and in again"


def _is_terminal(port: Path) -> bool:
    try:
        return stat.S_ISCHR(port.stat().st_mode)
    except OSError:
        return False


def _number(error: BaseException | None) -> int | None:
    """Return the errno of an error or of its cause; python-can gives it as error_code."""
    while error is not None:
        for name in ("errno", "error_code"):
            number = getattr(error, name, None)
            if isinstance(number, int):
                return number
        error = error.__cause__ or error.__context__
    return None
