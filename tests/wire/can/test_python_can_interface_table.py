"""What levid knows of python-can's interfaces, and buses that could not work, refused in words."""

from __future__ import annotations

import re
from typing import Any

import can
import pytest
from repository_folders import DOCS

from levid.config.base import ConfigError
from levid.config.buses import CanBus
from levid.config.rig import RigConfig, load_rig
from levid.config.shipped import shipped
from levid.drivers.base import Context
from levid.drivers.open_backends import check_backends
from levid.wire.can.python_can_interface_table import (
    ADAPTERS,
    adapter_of,
    arguments,
    check_bus,
    latency_s,
)

DOCS = (DOCS / "can.md").read_text()
SLCAN = {"interface": "slcan", "channel": "/dev/ttyACM0"}
# 80 MHz / (2 (1 + 31 + 8)) = 1 Mbit/s, 80 MHz / (2 (1 + 5 + 2)) = 5 Mbit/s
SEGMENTS = {
    "f_clock": 80_000_000,
    **{"nom_brp": 2, "nom_tseg1": 31, "nom_tseg2": 8, "nom_sjw": 8},
    **{"data_brp": 2, "data_tseg1": 5, "data_tseg2": 2, "data_sjw": 2},
}
PCAN_FD = {"interface": "pcan", "channel": "PCAN_USBBUS1", "data_bitrate": 5_000_000}


def test_every_interface_of_python_can_is_known() -> None:
    own = {name for name, (module, _) in can.interfaces.BACKENDS.items() if "can.interf" in module}
    assert own | {"levid_local"} == set(ADAPTERS)


def test_docs_tell_the_same_of_each() -> None:
    told: dict[str, list[str]] = {}
    table = DOCS.partition("## Adapters")[2].partition("\n\n`latency_s` is")[0]
    for row in re.findall(r"(?m)^\| (`.*)\|$", table):
        names, *cells = (cell.strip() for cell in row.split("|"))
        told |= dict.fromkeys(re.findall(r"`(\w+)`", names), cells)
    del told["interface"]
    assert set(told) == set(ADAPTERS)
    for name, (fd, latency, thread, besides) in told.items():
        adapter = adapter_of(name)
        if adapter.windows:
            assert "Windows" in besides
            continue
        assert float(latency) == adapter.latency_s, name
        assert (fd == "no") == (adapter.fd == "no"), name
        assert (thread == "no") == adapter.punctual, name
        assert adapter.line is None or adapter.line.option in besides


@pytest.mark.parametrize(
    "bus",
    [
        {"interface": "socketcan", "channel": "can0", "data_bitrate": 5_000_000},
        {"interface": "gs_usb", "channel": 0},
        {"interface": "gs_usb", "channel": "can", "options": {"bus": 1, "address": 4}},
        {"interface": "cantact", "channel": "0"},
        SLCAN,
        {**SLCAN, "bitrate": 500_000, "data_bitrate": 5_000_000},
        {**PCAN_FD, "options": SEGMENTS},
        {"interface": "pcan", "channel": "PCAN_PCIBUS1", "bitrate": 800_000},
        {"interface": "kvaser", "channel": 0, "data_bitrate": 4_000_000},
        {"interface": "kvaser", "channel": 0, "data_bitrate": 5_000_000, "options": SEGMENTS},
        {"interface": "socketcand", "channel": "can0", "options": {"host": "::1", "port": 29536}},
        {"interface": "canalystii", "channel": 0, "bitrate": 500_000},
        {"interface": "seeedstudio", "channel": "/dev/ttyUSB0"},
    ],
)
def test_what_can_work_passes(bus: dict[str, Any]) -> None:
    check_bus("can.main", CanBus(**bus))


@pytest.mark.parametrize(
    ("bus", "words"),
    [
        (
            {"interface": "socketcn", "channel": "can0"},
            r"can.main.interface: expected one of python-can \(.*slcan.*\) or of a package that "
            "adds one, found 'socketcn'; did you mean socketcan",
        ),
        (
            {"interface": "gs_usb", "channel": 0, "data_bitrate": 5_000_000},
            "can.main.data_bitrate: gs_usb of python-can carries classic CAN only, found 5000000",
        ),
        (
            {"interface": "gs_usb", "channel": "can0"},
            "expected the number of the adapter for gs_usb.*'can0'",
        ),
        (
            {"interface": "vector", "channel": 0},
            "can.main.interface: python-can supports vector on Windows only",
        ),
        (PCAN_FD, "can.main.options: pcan needs f_clock, nom_brp, .*data_sjw.*, found none"),
        (
            {**PCAN_FD, "data_bitrate": 2_000_000, "options": SEGMENTS},
            r"can.main.data_bitrate: expected 5e\+06, as computed from options, found 2000000",
        ),
        ({**PCAN_FD, "options": SEGMENTS | {"nom_brp": 0}}, "can.main.options: expected numbers"),
        # python-can would take 500000 instead, and say nothing
        (
            {"interface": "pcan", "channel": "PCAN_USBBUS1", "bitrate": 400_000},
            r"can.main.bitrate: expected a rate of pcan \(10000, .*found 400000",
        ),
        ({**SLCAN, "data_bitrate": 4_000_000}, r"rate of slcan \(2000000, 5000000\), found 4"),
        ({**SLCAN, "bitrate": 400_000}, "can.main.bitrate: expected a rate of slcan"),
        ({**SLCAN, "channel": "/dev/tty@fast"}, "can.main.options.tty_baudrate: .* found fast"),
        (
            {"interface": "kvaser", "channel": 0, "data_bitrate": 5_000_000},
            "can.main.data_bitrate: expected a rate of kvaser .*, or f_clock, nom_brp",
        ),
    ],
)
def test_what_cannot_work_is_refused_in_words(bus: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        check_bus("can.main", CanBus(**bus))


def test_a_rig_on_such_a_bus_does_not_pass() -> None:
    path = shipped("rigs/can.yaml")
    data = load_rig(path).model_dump()
    data["can"]["force"]["interface"] = "socketcn"
    rig = RigConfig.model_validate(data)
    with pytest.raises(ConfigError, match=r"can\.force\.interface: .*found 'socketcn'"):
        check_backends(Context(rig, 1.0 / rig.rate_hz, path.parent))


def test_latency_is_that_of_the_rig_or_what_is_usual() -> None:
    usb = {"interface": "gs_usb", "channel": 0}
    assert latency_s(CanBus(**usb)) == 1e-3
    assert latency_s(CanBus(**usb, latency_s=3e-4)) == 3e-4
    assert latency_s(CanBus(interface="of another package", channel=0)) == 1e-3


def test_python_can_is_given_what_each_interface_understands() -> None:
    assert arguments(CanBus(interface="udp_multicast", channel="x")) == {"fd": False}
    fd = arguments(CanBus(interface="socketcan", channel="x", data_bitrate=2_000_000))
    assert fd == {"fd": True, "data_bitrate": 2_000_000}
    for bitrate in adapter_of("slcan").fd_bitrates:
        for data_bitrate in (2_000_000, 5_000_000):
            bus = CanBus(**SLCAN, bitrate=bitrate, data_bitrate=data_bitrate)
            timing = arguments(bus)["timing"]
            assert (timing.nom_bitrate, timing.data_bitrate) == (bitrate, data_bitrate)
