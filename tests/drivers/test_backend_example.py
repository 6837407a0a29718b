"""The example of a backend in a package of its own, docs/examples/backend, checked and flown."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket

import numpy as np
import pytest
from repository_folders import DOCS

from levid.config.base import ConfigError, parse_text
from levid.config.rig import RigConfig, load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.daemon.loop.clock import VirtualClock
from levid.daemon.loop.virtual_flight import Flight
from levid.daemon.planning.plan import plan_session
from levid.drivers.base import AmplifierError, Context, StaleError
from levid.drivers.open_backends import check_backends, names, open_devices
from levid.log.reader import read_log
from levid.sim.electronics.emulated_rig import Electronics

EXAMPLE = DOCS / "examples" / "backend"
RATE_HZ = 250.0
SESSION = """
levid: session
name: example
excitations: {z: {input: z, rms_n: 0.5}}
steps:
  - levitate: {settle_s: 0.5}
  - record: {name: z, duration_s: 4, excite: [z]}
  - land: {}
"""


def register(site: Path, name: str, backends: dict[str, str]) -> None:
    """Write what pip writes of a package with these entry points."""
    info = site / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Name: {name}\nVersion: 1.0\n")
    entries = "".join(f"{key} = {value}\n" for key, value in backends.items())
    (info / "entry_points.txt").write_text(f"[levid.backends]\n{entries}")


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the example importable with the entry points of its pyproject.toml."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    register(tmp_path / "site", project["name"], project["entry-points"]["levid.backends"])
    monkeypatch.syspath_prepend(str(EXAMPLE))
    monkeypatch.syspath_prepend(str(tmp_path / "site"))


@pytest.fixture
def rig_file(tmp_path: Path, quiet_sim: Path) -> Path:
    """Write the rig that the example's README describes, on a port that is free."""
    (roles,) = re.findall(r"```yaml\n(.*?)```", (EXAMPLE / "README.md").read_text(), re.DOTALL)
    with socket(AF_INET, SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        roles = roles.replace("47110", str(free.getsockname()[1]))
    head = shipped("rigs/loopback.yaml").read_text().partition("amplifiers:")[0]
    head = re.sub(r"\.\./models", str(shipped("models/rig.yaml").parent), head)
    path = tmp_path / "udp.yaml"
    path.write_text(f"{head}\n{roles}\nsim: {quiet_sim}\n")
    return path


@pytest.fixture
def slow_rig(rig_file: Path) -> RigConfig:
    return load_rig(rig_file).model_copy(update={"rate_hz": RATE_HZ})


@pytest.mark.usefixtures("installed")
def test_check_reports_the_rate_that_the_bus_carries(levid: Callable, rig_file: Path) -> None:
    outcome = levid("check", rig_file)
    assert outcome.code == 0, outcome.err
    # 220 bytes of overhead and frames out and back at 100 Mbit/s, 0.2 ms of latency, waited for
    # within 0.8 of a period
    readings_s = 8 * ((3 + 36 + 48 + 4 + 66) + (3 + 1 + 36 + 1 + 36 + 3 + 72 + 4 + 66)) / 1e8
    assert f"{0.8 / (readings_s + 2e-4):.0f} Hz" in outcome.out


@pytest.mark.usefixtures("installed")
def test_a_rate_that_the_bus_does_not_carry_is_an_error(levid: Callable, rig_file: Path) -> None:
    rig_file.write_text(rig_file.read_text().replace("rate_hz: 1000", "rate_hz: 10000"))
    outcome = levid("check", rig_file)
    assert outcome.code == 1
    assert "udp main is busy" in outcome.err


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("host:", "hots:", r"udp.main.hots: unknown key; expected 'host'"),
        ("port: ", "port: 1", r"udp.main.port: expected .*65535"),
        ("sensors: {backend: udp, bus: main", "sensors: {backend: udp, bus: x", r"sensors.bus:"),
        ("expire_cycles: 3", "expire: 3", r"expire: unknown key"),
    ],
)
def test_mistakes_in_its_sections_are_named(old: str, new: str, words: str, rig_file: Path) -> None:
    text = rig_file.read_text()
    assert old in text
    rig_file.write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=words):
        check_backends(Context(load_rig(rig_file), 1e-3, rig_file.parent))


@pytest.mark.usefixtures("installed")
def test_a_rig_survives_the_way_to_another_process(rig_file: Path) -> None:
    rig = load_rig(rig_file)
    assert RigConfig.model_validate_json(rig.model_dump_json()) == rig
    assert "udp" in names()


def test_without_the_package_a_rig_is_read_and_its_backend_is_missing(rig_file: Path) -> None:
    """The rig in a log is read on machines that never fly it."""
    rig = load_rig(rig_file)
    with pytest.raises(ConfigError, match=r"amplifiers.backend: expected one of can, loopback"):
        check_backends(Context(rig, 1e-3, rig_file.parent))


@pytest.mark.usefixtures("installed", "host_paced")
def test_a_session_flies_over_it(slow_rig: RigConfig, tmp_path: Path) -> None:
    session = parse_text(SESSION, SessionConfig, "example")
    out = tmp_path / "out"
    out.mkdir()
    with (
        Electronics(slow_rig, tmp_path),
        Flight(slow_rig, tmp_path, RATE_HZ, VirtualClock()) as flight,
    ):
        flight.idle(60)  # amplifiers are enabled at zero force
        plan = plan_session(session, slow_rig, flight.beam_m, flight.rotor_rad)
        result = flight.fly(plan, out, {})
        assert flight.devices.stale == 0
    rows = read_log(result.records[0]).rows
    # 0.5 N rms, white to 125 Hz, on 7 kg and 2600 N/m moves by tens of micrometres.
    assert rows["z_m"].std() > 5e-6
    assert np.abs(rows["gap_m"]).max() < 6e-4  # it flew: the stops are at 0.9 mm


@pytest.mark.usefixtures("installed", "host_paced")
@pytest.mark.parametrize(("fault", "error"), [("trip 3", AmplifierError), ("corrupt", StaleError)])
def test_faults_of_its_electronics_are_detected(
    slow_rig: RigConfig, tmp_path: Path, patience, fault: str, error: type
) -> None:
    # A corrupt answer never counts: its wait has to end soon.
    patience.seconds = 2.0 / RATE_HZ
    coil_n, gap_m = np.zeros(9), np.zeros(9)
    with Electronics(slow_rig, tmp_path) as electronics:
        devices = open_devices(Context(slow_rig, 1 / RATE_HZ, tmp_path))

        def run(cycles: int) -> None:
            for cycle in range(cycles):
                devices.sync(cycle)
                devices.sensors.read(gap_m)
                devices.amplifiers.read(coil_n)

        electronics.injector.command(fault)
        try:
            with pytest.raises(error):
                run(20)
        finally:
            devices.close()


def test_an_entry_point_may_name_a_backend_class(
    rig_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A backend without buses needs no descriptor; one that cannot be loaded is named."""
    register(
        tmp_path / "site",
        "plain",
        {"plain": "levid.drivers.loopback:LoopbackBackend", "lost": "no:X"},
    )
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    data = load_rig(rig_file).model_dump(exclude={"udp"})
    for name in ("plain", "lost"):
        data |= {role: {"backend": name} for role in ("amplifiers", "sensors", "drives")}
        context = Context(RigConfig.model_validate(data), 1e-3, rig_file.parent)
        if name == "plain":
            assert not check_backends(context).buses
        else:
            with pytest.raises(ConfigError, match="backend 'lost': cannot load no:X"):
                check_backends(context)
