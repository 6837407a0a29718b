"""What systemd, networkd and udev have to know of a rig: files, by the path where they belong."""

from __future__ import annotations

import hashlib
import re
import shutil
import stat
from collections.abc import Iterator, Mapping
from math import ceil
from pathlib import Path, PurePosixPath

from ...config.base import ConfigError
from ...config.buses import CanBus
from ...config.rig import RigConfig
from ...config.shipped import shipped
from ...drivers.base import Context
from ...drivers.registry import check_backends
from ..control.feed_forward import feed_forward
from ..host.access_control import Access

UNIT = "etc/systemd/system/levid.service"
DROP_IN = "etc/systemd/system/levid.service.d/10-rig.conf"
SYSUSERS = "etc/sysusers.d/levid.conf"
UDEV = "etc/udev/rules.d/70-levid.rules"
NETWORK = "etc/systemd/network/70-levid-"
_SYSTEM = "etc/systemd/system"
_PATIENCE = """\
# An adapter that is not plugged in keeps the daemon waiting no longer than this.
[Service]
TimeoutStartSec=20
"""
_USB = ("ttyUSB", "ttyACM")
_KERNELS = ("tty", "hvc", "rfcomm")
"""How the kernel's own names of ports begin."""
_SILENT_S, _BEYOND_S = 1.0, 4
"""Of the rig, at which the unit's watchdog is as it is; and how much later than that it bites, so
that loop or supervisor have been found to be silent, and zero force is, before."""
_LANDING_S = 60
_QUEUE = 64
_CAN_FD_MTU = 72
_INTERNET = ("udp_multicast", "socketcand")
_OF_PROCESSES = ("levid_local", "virtual")
_HEAD = "# Written by levid install-service; changes by hand keep it from being written anew: "
_HIDDEN = ("/tmp", "/var/tmp", "/root", "/run/user")
_HOMES = ("/home", "/root", "/run/user")


def service_files(rig: RigConfig, rig_file: Path, program: Path) -> dict[str, str]:
    """Return the texts of all files, by their paths without the leading slash.

    `program` is the `levid` that the service runs.
    """
    files = {
        SYSUSERS: 'u levid - "levid daemon" /var/lib/levid\n',
        UNIT: shipped("levid.service").read_text(),
        DROP_IN: _drop_in(rig, rig_file, program),
        UDEV: _udev(rig),
    }
    for bus in _kernel_buses(rig):
        files |= _network(bus)
    return {path: _signed(text) for path, text in files.items()}


def hindrances(rig: RigConfig, rig_file: Path, program: Path) -> Iterator[str]:
    """Say what would keep the service from running, or what it is not told here."""
    try:
        check_backends(Context(rig, 1.0 / rig.rate_hz, rig_file.parent))
        feed_forward(rig, 1.0 / rig.rate_hz)
        Access(rig.service)
    except ConfigError as error:
        yield f"the daemon will not start: {error}"
    for path in (rig_file, program):
        where = next((hidden for hidden in _HIDDEN if path.is_relative_to(hidden)), None)
        if where is not None:
            yield f"{path} lies in {where}, where user levid sees nothing: move it"
        elif (shut := _shut(path)) is not None:
            yield f"{path}: user levid may not enter {shut} (chmod o+x {shut}), or move it"
    for name, bus in rig.can.items():
        if bus.interface != "socketcan" and _tty(bus) is None:
            yield f"can.{name}: {bus.interface} is nothing that networkd knows: {_left(bus)}"
    for port in _ports(rig):
        leads_to = Path(port).resolve()
        if _is_link(port) and leads_to.exists() and not leads_to.name.startswith(_USB):
            yield f"{port} is a link to {leads_to}: name that; links are taken for USB adapters"
    if rig.socket is not None and not Path(rig.socket).is_relative_to("/run/levid"):
        yield f"socket: expected a path in /run/levid, found {rig.socket}"
    if rig.recording.faults is not None:
        folder = rig_file.parent / rig.recording.faults
        if not folder.is_relative_to("/var/lib/levid"):
            yield f"recording.faults: expected a folder in /var/lib/levid, found {folder}"


def left_over(files: Mapping[str, str], root: Path) -> list[Path]:
    """Return the files of interfaces that were written below `root` for a rig before this one."""
    patterns = (f"{NETWORK}*", f"{_SYSTEM}/{_waiting('*')}.d/10-levid.conf")
    found = {path for pattern in patterns for path in root.glob(pattern)}
    found -= {root / path for path in files}
    return sorted(path for path in found if _is_ours(path.read_text(errors="replace")))


def write(files: Mapping[str, str], root: Path, force: bool) -> dict[str, str]:
    """Write files below `root`; return what was done with each: written, unchanged, replaced.

    Raises:
        ConfigError: a file was changed by hand, and nothing was written; not with `force`.
        OSError: one cannot be written.
    """
    done = preview(files, root)
    strange = [path for path, what in done.items() if what == "changed by hand"]
    if strange and not force:
        names = ", ".join(str(root / path) for path in strange)
        raise ConfigError(
            f"changed by hand, or somebody else's: {names}; nothing is written. Put your changes "
            "into a file of your own beside it, or replace it with --force"
        )
    for path, text in files.items():
        if done[path] == "unchanged":
            continue
        if done[path] == "new":
            done[path] = "written"
        target = root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        if done[path] == "changed by hand":
            shutil.copyfile(target, target.with_name(f"{target.name}.old"))
            done[path] = f"replaced, the old one is {target.name}.old"
        target.write_text(text)
    return done


def preview(files: Mapping[str, str], root: Path) -> dict[str, str]:
    """Return what `write` would find: new, unchanged, written anew, changed by hand."""
    return {path: _done(root / path, text) for path, text in files.items()}


def _shut(path: Path) -> Path | None:
    """Return the first folder on the way to a path that others may not enter; None for none."""
    for folder in reversed(path.parents):
        try:
            if not folder.stat().st_mode & stat.S_IXOTH:
                return folder
        except OSError:
            return None
    return None


def _signed(text: str) -> str:
    return f"{_HEAD}{hashlib.sha256(text.encode()).hexdigest()[:16]}\n{text}"


def _done(target: Path, text: str) -> str:
    if not target.exists():
        return "new"
    found = target.read_text(errors="replace")
    if found == text:
        return "unchanged"
    return "written anew" if _is_ours(found) else "changed by hand"


def _is_ours(text: str) -> bool:
    """Return whether a file is as it was written here, by any version."""
    first, _, rest = text.partition("\n")
    return first.startswith(_HEAD) and _signed(rest) == text


def _drop_in(rig: RigConfig, rig_file: Path, program: Path) -> str:
    interfaces = [str(bus.channel) for bus in _kernel_buses(rig)]
    # Up to its time limit: an adapter that is not there is a fault, and the daemon starts.
    units = [_waiting(name) for name in interfaces]
    classes = _device_classes(rig)
    if any(device.startswith("char-") for device in classes):
        # Classes of devices are looked up once, as the service starts: their drivers come first.
        units += [f"modprobe@{driver}.service" for driver in ("usbserial", "cdc_acm")]
    units += [_device_unit(device) for device in classes if device.startswith("/dev/")]
    lines = ["[Unit]", *(line for unit in units for line in (f"Wants={unit}", f"After={unit}"))]
    lines += [f'RequiresMountsFor="{_literal(path)}"' for path in (rig_file, program)]
    lines += ["", "[Service]", "ExecStart=", f"ExecStart={_word(program)} run {_word(rig_file)}"]
    silent_s = max(rig.service.loop_s, rig.service.supervisor_s)
    if silent_s > _SILENT_S:
        lines += [
            "# The rig lets a process be silent for longer:",
            f"WatchdogSec={_watchdog(silent_s)}",
        ]
    if rig.service.supervisor_gone == "land":
        lines += [
            "# Who lands without a supervisor needs its time:",
            f"TimeoutAbortSec={_LANDING_S}",
        ]
    if any(path.is_relative_to(home) for path in (rig_file, program) for home in _HOMES):
        lines += ["# levid or its rig lies in a home:", "ProtectHome=read-only"]
    if _ports(rig):
        lines += [f"DeviceAllow={device} rw" for device in classes]
    if rig.service.metrics_port is not None or _speaks_ip(rig):
        lines += ["RestrictAddressFamilies=AF_INET AF_INET6"]
        lines += ["IPAddressAllow=any" if _speaks_ip(rig) else "IPAddressAllow=localhost"]
    return "\n".join(lines) + "\n"


def _udev(rig: RigConfig) -> str:
    lines = [
        "# Processors that stay awake: the loop asks for it (realtime.cpu_latency_us).",
        'KERNEL=="cpu_dma_latency", GROUP="levid", MODE="0660"',
    ]
    for kernel in _port_names(rig):
        lines += [
            f'SUBSYSTEM=="tty", KERNEL=="{kernel}", GROUP="levid", MODE="0660", '
            'ENV{ID_MM_DEVICE_IGNORE}="1"'
        ]
    if _ports(rig):
        lines += [
            "# FTDI adapters keep what they received for 16 ms unless told otherwise.",
            'ACTION!="remove", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", '
            'ATTR{latency_timer}="1"',
        ]
    return "\n".join(lines) + "\n"


def _network(bus: CanBus) -> dict[str, str]:
    """Return the files of one interface: queue, bitrates, that it comes back."""
    name = str(bus.channel)
    match = f"[Match]\nName={name}\n\n"
    online = "[Link]\nRequiredForOnline=carrier\n"
    patience = {f"{_SYSTEM}/{_waiting(name)}.d/10-levid.conf": _PATIENCE}
    if name.startswith("vcan"):
        mtu = f"MTUBytes={_CAN_FD_MTU}\n" if bus.fd else ""
        netdev = f"[NetDev]\nName={name}\nKind=vcan\n{mtu}"
        return patience | {
            f"{NETWORK}{name}.netdev": netdev,
            f"{NETWORK}{name}.network": f"{match}{online}",
        }
    rates = f"BitRate={bus.bitrate}\n"
    if bus.fd:
        rates += f"FDMode=yes\nDataBitRate={bus.data_bitrate}\n"
    link = (
        "# With several adapters, match each by where it is plugged in (udevadm info\n"
        f"# /sys/class/net/{name}) and name it: in a copy, 60-levid-{name}.link, which comes\n"
        f"# before this one, Property=ID_PATH=... below [Match] and Name={name} below [Link].\n"
        f"[Match]\nOriginalName={name}\n\n"
        f"[Link]\nNamePolicy=keep\nTransmitQueueLength={_QUEUE}\n"
    )
    return patience | {
        f"{NETWORK}{name}.link": link,
        f"{NETWORK}{name}.network": f"{match}{online}\n[CAN]\n{rates}RestartSec=100ms\n",
    }


def _kernel_buses(rig: RigConfig) -> list[CanBus]:
    """Return the CAN buses that are network interfaces of the kernel, each once."""
    found = {str(b.channel): b for b in rig.can.values() if b.interface == "socketcan"}
    for name in found:
        if not re.fullmatch(r"[A-Za-z0-9_.-]{1,15}", name):
            raise ConfigError(f"can: channel: expected the name of an interface, found '{name}'")
    return list(found.values())


def _tty(bus: CanBus) -> str | None:
    """Return the port of an adapter that is on one, as slcan's are; None for others."""
    port = str(bus.channel).partition("@")[0]
    return port if port.startswith("/dev/") else None


def _left(bus: CanBus) -> str:
    """Return what there is to do for an adapter that is neither an interface nor on a port."""
    if bus.interface in (*_INTERNET, *_OF_PROCESSES):
        return "it is left to you"
    return (
        "an adapter on USB needs DeviceAllow=char-usb_device rw and "
        "RestrictAddressFamilies=AF_NETLINK (systemctl edit levid), and a rule of udev that gives "
        "it to group levid"
    )


def _ports(rig: RigConfig) -> list[PurePosixPath]:
    """Return the ports of serial buses and CAN adapters that are devices of this machine."""
    named = [bus.port for bus in rig.serial.values()]
    named += [port for bus in rig.can.values() if (port := _tty(bus)) is not None]
    return [PurePosixPath(port) for port in named if port.startswith("/dev/")]


def _port_names(rig: RigConfig) -> list[str]:
    """Return the kernel's names of serial ports; a link may point to any USB adapter."""
    names = [port.name for port in _ports(rig) if not _is_link(port)]
    usb = [name for name in names if name.startswith(_USB)]
    linked = len(names) < len(_ports(rig))
    plain = sorted(set(names) - set(usb))
    return plain + (["ttyUSB[0-9]*", "ttyACM[0-9]*"] if usb or linked else [])


def _is_link(port: PurePosixPath) -> bool:
    """Return whether a port is a name that rules of udev made, not the kernel's own."""
    return port.parent != PurePosixPath("/dev") or not port.name.startswith(_KERNELS)


def _device_classes(rig: RigConfig) -> list[str]:
    """Return what the cgroup of the service lets through: a class, for adapters come and go."""
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
    return ceil(silent_s) + _BEYOND_S


def _literal(path: Path) -> str:
    """Return a path as it stands between quotes in a unit."""
    return str(path).replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")


def _word(path: Path) -> str:
    """Return a path as one word of a command line in a unit."""
    text = _literal(path).replace("$", "$$")
    return f'"{text}"' if re.search(r"[\s\\\"';]", text) else text


def _waiting(interface: str) -> str:
    """Return the unit that waits for an interface."""
    return f"systemd-networkd-wait-online@{_escaped(interface)}.service"


def _device_unit(path: str) -> str:
    return "-".join(_escaped(part) for part in path.strip("/").split("/")) + ".device"


def _escaped(name: str) -> str:
    """Return a name as systemd-escape does; interfaces and ports have none but these."""
    return name.replace("-", "\\x2d")
