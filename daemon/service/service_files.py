"""Generate the systemd, networkd and udev files of a rig, and install them."""

from __future__ import annotations

import hashlib
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from math import ceil
from pathlib import Path, PurePosixPath

from ...config.base import ConfigError
from ...config.buses import CanBus
from ...config.escaping import (
    EscapingError,
    shell_word,
    systemd_name,
    systemd_text,
    systemd_word,
    udev_name,
)
from ...config.files.atomic_write import write_file
from ...config.files.folders import make_folder
from ...config.rig import RigConfig
from ...config.shipped import shipped
from ...drivers.base import Context
from ...drivers.open_backends import check_backends
from ..control.feed_forward import feed_forward
from ..host.peer_credentials import Access

UNIT = "etc/systemd/system/levid.service"
DROP_IN = "etc/systemd/system/levid.service.d/10-rig.conf"
SYSUSERS = "etc/sysusers.d/levid.conf"
UDEV = "etc/udev/rules.d/70-levid.rules"
NETWORK = "etc/systemd/network/70-levid-"
_SYSTEM = "etc/systemd/system"
_WAIT_ONLINE = """\
# Longest delay of the daemon's start by an adapter that is not plugged in.
[Service]
TimeoutStartSec=20
"""
_USB = ("ttyUSB", "ttyACM")
_KERNEL_PORTS = ("tty", "hvc", "rfcomm")
"""Prefixes of the kernel's port names."""
_SILENT_S, _WATCHDOG_MARGIN_S = 1.0, 4
"""Watchdog time of the rig that WatchdogSec of the unit suits, and their difference: the daemon's
own watchdogs command zero force before systemd restarts it."""
_LANDING_S = 60
_QUEUE = 64
_CAN_FD_MTU = 72
_INTERNET = ("udp_multicast", "socketcand")
_IN_PROCESS = ("levid_local", "virtual")
_STATE = "/var/lib/levid"
_HEAD = "# Written by levid install-service; changes by hand keep it from being written anew: "
_HIDDEN = ("/tmp", "/var/tmp", "/root", "/run/user")
_HOMES = ("/home", "/root", "/run/user")


def service_files(
    rig: RigConfig, rig_file: Path, program: Path, model_file: Path | None = None
) -> dict[str, str]:
    """Return the texts of all files by path, without the leading slash.

    `program` is the path of the `levid` command that the service runs, `model_file` the MODEL.yaml
    that the rig names. Raises ConfigError.
    """
    read = [path for path in (rig_file, program, model_file) if path is not None]
    try:
        files = {
            SYSUSERS: 'u levid - "levid daemon" /var/lib/levid\n',
            UNIT: shipped("levid.service").read_text(),
            DROP_IN: _drop_in(rig, rig_file, program, read),
            UDEV: _udev(rig),
        }
    except EscapingError as error:
        raise ConfigError(f"{rig_file}: cannot be installed as a service: {error}") from None
    for bus in _kernel_buses(rig):
        files |= _network(bus)
    return {path: _signed(text) for path, text in files.items()}


def service_warnings(
    rig: RigConfig, rig_file: Path, program: Path, model_file: Path | None = None
) -> Iterator[str]:
    """Yield a warning for each problem of the rig or paths that the service would have."""
    try:
        check_backends(Context(rig, 1.0 / rig.rate_hz, rig_file.parent))
        feed_forward(rig, 1.0 / rig.rate_hz)
        Access(rig.service)
    except ConfigError as error:
        yield f"the daemon will not start: {error}"
    for path in (rig_file, program, model_file):
        if path is None:
            continue
        where = next((hidden for hidden in _HIDDEN if path.is_relative_to(hidden)), None)
        if where is not None:
            yield f"{path}: user levid has no access to {where}: move the file"
        elif (closed := _closed_folder(path)) is not None:
            remedy = f"chmod o+x {shell_word(closed)}, or move it"
            yield f"{path}: user levid has no access to {closed}: {remedy}"
    for name, bus in rig.can.items():
        if bus.interface != "socketcan" and _tty(bus) is None:
            yield f"can.{name}: networkd cannot configure {bus.interface}: {_manual_step(bus)}"
    for port in _ports(rig):
        leads_to = Path(port).resolve()
        if _is_link(port) and leads_to.exists() and not leads_to.name.startswith(_USB):
            yield f"{port} is a link to {leads_to}: expected USB behind a link; use {leads_to}"
    if rig.socket is not None and not Path(rig.socket).is_relative_to("/run/levid"):
        yield f"socket: expected a path in /run/levid, found {rig.socket}"
    if rig.recording.faults is not None:
        folder = rig_file.parent / rig.recording.faults
        if not folder.is_relative_to("/var/lib/levid"):
            yield f"recording.faults: expected a folder in /var/lib/levid, found {folder}"


def left_over(files: Mapping[str, str], root: Path) -> list[Path]:
    """Return the interface files below `root` that were written for an earlier rig."""
    patterns = (f"{NETWORK}*", f"{_SYSTEM}/systemd-networkd-wait-online@*.service.d/10-levid.conf")
    found = {path for pattern in patterns for path in root.glob(pattern)}
    found -= {root / path for path in files}
    return sorted(path for path in found if _is_ours(path.read_text(errors="replace")))


def write(files: Mapping[str, str], root: Path, force: bool) -> dict[str, str]:
    """Write files below `root`; return the action for each: written, unchanged, replaced.

    Raises:
        ConfigError: a file was changed by hand and `force` is False; no file is written.
        OSError: a file cannot be written.
    """
    done = preview(files, root)
    changed = [path for path, action in done.items() if action == "changed by hand"]
    if changed and not force:
        names = ", ".join(str(root / path) for path in changed)
        raise ConfigError(
            f"changed by hand, or not written by levid: {names}; no file is written. Move your "
            "changes to a drop-in file beside it, or replace it with --force"
        )
    for path, text in files.items():
        if done[path] == "unchanged":
            continue
        if done[path] == "new":
            done[path] = "written"
        target = root / path
        make_folder(target.parent)
        if done[path] == "changed by hand":
            write_file(target.with_name(f"{target.name}.old"), target.read_bytes())
            done[path] = f"replaced; the old file is {target.name}.old"
        write_file(target, text)
    return done


def preview(files: Mapping[str, str], root: Path) -> dict[str, str]:
    """Return the action for each file: new, unchanged, updated, changed by hand."""
    return {path: _action(root / path, text) for path, text in files.items()}


def _closed_folder(path: Path) -> Path | None:
    """Return the first parent folder that other users may not enter; None if there is none."""
    for folder in reversed(path.parents):
        try:
            if not folder.stat().st_mode & stat.S_IXOTH:
                return folder
        except OSError:
            return None
    return None


def _signed(text: str) -> str:
    return f"{_HEAD}{hashlib.sha256(text.encode()).hexdigest()[:16]}\n{text}"


def _action(target: Path, text: str) -> str:
    if not target.exists():
        return "new"
    found = target.read_text(errors="replace")
    if found == text:
        return "unchanged"
    return "updated" if _is_ours(found) else "changed by hand"


def _is_ours(text: str) -> bool:
    """Return whether any version of levid wrote this text and it was not changed."""
    first, _, rest = text.partition("\n")
    return first.startswith(_HEAD) and _signed(rest) == text


def _drop_in(rig: RigConfig, rig_file: Path, program: Path, read: Sequence[Path]) -> str:
    interfaces = [str(bus.channel) for bus in _kernel_buses(rig)]
    # With a time limit: without the adapter, the daemon starts in a fault.
    units = [_wait_online_unit(name) for name in interfaces]
    classes = _device_classes(rig)
    if any(device.startswith("char-") for device in classes):
        # Device classes are resolved once, at the service start: load their drivers before.
        units += [f"modprobe@{driver}.service" for driver in ("usbserial", "cdc_acm")]
    units += [_device_unit(device) for device in classes if device.startswith("/dev/")]
    lines = ["[Unit]", *(line for unit in units for line in (f"Wants={unit}", f"After={unit}"))]
    lines += [f'RequiresMountsFor="{systemd_text(path)}"' for path in read]
    lines += [
        "",
        "[Service]",
        "ExecStart=",
        f"ExecStart={systemd_word(program)} run {systemd_word(rig_file)}",
    ]
    silent_s = max(rig.service.loop_s, rig.service.supervisor_s)
    if silent_s > _SILENT_S:
        lines += [
            "# The rig has longer watchdog times:",
            f"WatchdogSec={_watchdog(silent_s)}",
        ]
    if rig.service.supervisor_gone == "land":
        lines += [
            "# Time to land without a supervisor:",
            f"TimeoutAbortSec={_LANDING_S}",
        ]
    if any(path.is_relative_to(home) for path in read for home in _HOMES):
        lines += ["# levid or its rig is in a home directory:", "ProtectHome=read-only"]
    for written in _written_folders(rig, rig_file):
        lines += [f'ReadWritePaths="-{systemd_text(written)}"']
    if _ports(rig):
        lines += [f"DeviceAllow={device} rw" for device in classes]
    if rig.service.metrics_port is not None or rig.live is not None or _speaks_ip(rig):
        lines += ["RestrictAddressFamilies=AF_INET AF_INET6"]
        lines += ["IPAddressAllow=any" if _speaks_ip(rig) else "IPAddressAllow=localhost"]
    if rig.live is not None:
        lines += ["# The live view forbids itself system calls:", "SystemCallFilter=seccomp"]
    return "\n".join(lines) + "\n"


def _written_folders(rig: RigConfig, rig_file: Path) -> Iterator[Path]:
    """Yield the folders of logs and flight recordings that are not the service's own."""
    for folder in (rig.recording.root, rig.recording.faults):
        path = rig_file.parent / folder if folder is not None else None
        if path is not None and not path.is_relative_to(_STATE):
            yield path


def _udev(rig: RigConfig) -> str:
    lines = [
        "# The loop sets the wake-up latency of processors (realtime.cpu_latency_us).",
        'KERNEL=="cpu_dma_latency", GROUP="levid", MODE="0660"',
    ]
    for kernel in _port_names(rig):
        lines += [
            f'SUBSYSTEM=="tty", KERNEL=="{kernel}", GROUP="levid", MODE="0660", '
            'ENV{ID_MM_DEVICE_IGNORE}="1"'
        ]
    if _ports(rig):
        lines += [
            "# FTDI adapters buffer received bytes for 16 ms by default.",
            'ACTION!="remove", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", '
            'ATTR{latency_timer}="1"',
        ]
    return "\n".join(lines) + "\n"


def _network(bus: CanBus) -> dict[str, str]:
    """Return the files of one interface: queue length, bit rates, restart after bus-off."""
    name = str(bus.channel)
    match = f"[Match]\nName={name}\n\n"
    online = "[Link]\nRequiredForOnline=carrier\n"
    wait_online = {f"{_SYSTEM}/{_wait_online_unit(name)}.d/10-levid.conf": _WAIT_ONLINE}
    if name.startswith("vcan"):
        mtu = f"MTUBytes={_CAN_FD_MTU}\n" if bus.fd else ""
        netdev = f"[NetDev]\nName={name}\nKind=vcan\n{mtu}"
        return wait_online | {
            f"{NETWORK}{name}.netdev": netdev,
            f"{NETWORK}{name}.network": f"{match}{online}",
        }
    rates = f"BitRate={bus.bitrate}\n"
    if bus.fd:
        rates += f"FDMode=yes\nDataBitRate={bus.data_bitrate}\n"
    link = (
        "# With several adapters, match each by its USB port (udevadm info\n"
        f"# /sys/class/net/{name}): copy this file to 60-levid-{name}.link, which takes\n"
        f"# precedence; set Property=ID_PATH=... below [Match] and Name={name} below [Link].\n"
        f"[Match]\nOriginalName={name}\n\n"
        f"[Link]\nNamePolicy=keep\nTransmitQueueLength={_QUEUE}\n"
    )
    return wait_online | {
        f"{NETWORK}{name}.link": link,
        f"{NETWORK}{name}.network": f"{match}{online}\n[CAN]\n{rates}RestartSec=100ms\n",
    }


def _kernel_buses(rig: RigConfig) -> list[CanBus]:
    """Return the CAN buses that are kernel network interfaces, without duplicates."""
    found = {str(b.channel): b for b in rig.can.values() if b.interface == "socketcan"}
    for name in found:
        if not re.fullmatch(r"[A-Za-z0-9_.-]{1,15}", name):
            raise ConfigError(f"can: channel: expected an interface name, found '{name}'")
    return list(found.values())


def _tty(bus: CanBus) -> str | None:
    """Return the serial port of an adapter such as slcan's; None for other adapters."""
    port = str(bus.channel).partition("@")[0]
    return port if port.startswith("/dev/") else None


def _manual_step(bus: CanBus) -> str:
    """Return what the user has to do for an adapter without network interface or serial port."""
    if bus.interface in (*_INTERNET, *_IN_PROCESS):
        return "configure it yourself"
    return (
        "for an adapter on USB, add DeviceAllow=char-usb_device rw and "
        "RestrictAddressFamilies=AF_NETLINK (systemctl edit levid), and a udev rule that gives "
        "group levid access"
    )


def _ports(rig: RigConfig) -> list[PurePosixPath]:
    """Return the device paths of serial buses and CAN adapters on this machine."""
    named = [bus.port for bus in rig.serial.values()]
    named += [port for bus in rig.can.values() if (port := _tty(bus)) is not None]
    return [PurePosixPath(port) for port in named if port.startswith("/dev/")]


def _port_names(rig: RigConfig) -> list[str]:
    """Return the kernel names of serial ports; a link may lead to any USB adapter."""
    names = [udev_name(port.name) for port in _ports(rig) if not _is_link(port)]
    usb = [name for name in names if name.startswith(_USB)]
    linked = len(names) < len(_ports(rig))
    plain = sorted(set(names) - set(usb))
    return plain + (["ttyUSB[0-9]*", "ttyACM[0-9]*"] if usb or linked else [])


def _is_link(port: PurePosixPath) -> bool:
    """Return whether a port is a udev link and not a kernel name."""
    return port.parent != PurePosixPath("/dev") or not port.name.startswith(_KERNEL_PORTS)


def _device_classes(rig: RigConfig) -> list[str]:
    """Return the DeviceAllow entries: a class for USB, since an adapter may be replugged."""
    classes = []
    for name in _port_names(rig):
        family = re.match(r"[A-Za-z]+", name)
        usb = name.startswith(_USB)
        classes.append(f"char-{family[0]}" if usb and family else f"/dev/{name}")
    return classes


def _speaks_ip(rig: RigConfig) -> bool:
    urls = any("://" in bus.port for bus in rig.serial.values())
    return urls or any(bus.interface in _INTERNET for bus in rig.can.values())


def _watchdog(silent_s: float) -> int:
    return ceil(silent_s) + _WATCHDOG_MARGIN_S


def _wait_online_unit(interface: str) -> str:
    """Return the name of the unit that waits for an interface."""
    return f"systemd-networkd-wait-online@{systemd_name(interface)}.service"


def _device_unit(path: str) -> str:
    return f"{systemd_name(path)}.device"
