"""Fixtures of more than one test file."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Generator, Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest
from hypothesis import HealthCheck, settings
from scheduling_delay import Watch, Witness

from levid.cli.main import main
from levid.config.base import parse_text
from levid.config.rig import RigConfig, with_model
from levid.config.shipped import shipped
from levid.drivers.bus_backend import AnswerTime

# A slow machine is no reason to fail.
_PATIENT = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("levid", max_examples=1000, **_PATIENT)
settings.register_profile("million", max_examples=1_000_000, **_PATIENT)
settings.load_profile("levid")

_TESTS = Path(__file__).parent
_WATCH = pytest.StashKey[Watch]()
_COMPUTE = (
    "api",
    *("cli", "compatibility", "config", "docs", "identification", "log", "model", "packaging"),
    *("report", "sim", "wire", "daemon/control", "daemon/ipc", "daemon/service/test_service_files"),
    *("daemon/loop/test_flight_ends", "daemon/loop/test_virtual_flight"),
    *("daemon/live/test_decimation", "daemon/live/test_page_data", "daemon/live/test_request_head"),
    *("daemon/planning/test_excitation", "daemon/planning/test_orthogonal_multisine"),
    *(
        "daemon/planning/test_plan.py",
        "daemon/planning/test_long_records",
        "daemon/recording/test_coil_heat_file",
    ),
    *("benchmarks/test_coverage_and_largest_error", "benchmarks/test_log_rows_vs_commit"),
    *("benchmarks/test_simulated_unlisted_effects", "benchmarks/test_hidden_effects"),
    *("benchmarks/test_imported_plant_simulation", "benchmarks/test_search_numbers"),
    *("benchmarks/test_search_option_sensitivity", "benchmarks/test_support_calibration"),
    *("benchmarks/test_sticking_plants", "benchmarks/test_swinging_plants"),
    *("drivers/can/test_canopen_fuzz", "drivers/can/test_reading_collector_fuzz"),
    *("drivers/can/test_sdo_fuzz", "drivers/serial/test_transaction_fuzz"),
)
"""Tests that only compute, so that several of them may run at the same time."""
_WAIT = (
    "cli/watch/test_terminal_screen",
    "cli/watch/test_watch_app",
    "report/browser",
    "report/session/test_session_page",
    "wire/can/test_local_bus",
    "wire/can/test_receive_thread",
)
"""Tests among them that wait for clocks or processes."""
_LONG = (
    "api/test_own_script",
    "api/test_types_of_public_names",
    "benchmarks/test_killed_processes",
    "daemon/supervision/test_coil_check_at_lift_off",
    "daemon/test_flights_on_a_bus",
    "daemon/test_processes_killed",
    "docs/test_notebooks",
    "identification/trace/force_trace/test_drawn_plants",
    "identification/trace/force_trace/test_erring_sensors",
    "identification/trace/force_trace/test_loops_under_random_forces",
    "identification/trace/force_trace/test_point_to_point_moves",
    "identification/trace/test_worker_pool",
    "report/browser/test_pages_of_a_flight",
)
"""Tests that take minutes, or trace one plant after another: `make test-long`, `.ci/run`."""


def pytest_configure() -> None:
    """Refuse a list above that names a file which was renamed or deleted."""
    for name in (*_COMPUTE, *_WAIT, *_LONG):
        if not (_TESTS / name).exists() and not (_TESTS / f"{name}.py").exists():
            raise pytest.UsageError(f"tests/conftest.py: expected tests/{name}, found none")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that a busy machine could fail."""
    for item in items:
        path = item.path.relative_to(_TESTS).as_posix()
        if path.startswith(_WAIT) or not path.startswith(_COMPUTE):
            item.add_marker(pytest.mark.alone)
        if path.startswith(_LONG):
            item.add_marker(pytest.mark.long)


@pytest.fixture(scope="session", autouse=True)
def _state_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """How hot coils are is kept for the next daemon: of those of tests, not in this user's home."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("STATE_DIRECTORY", raising=False)
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session")
def witness() -> Iterator[Witness]:
    """A process beside the tests that tells how punctual the machine is."""
    witness = Witness()
    yield witness
    witness.close()


@pytest.fixture(autouse=True)
def _watch(request: pytest.FixtureRequest) -> None:
    """Watch the machine while a test of what flies in real time runs."""
    if request.node.get_closest_marker("real_time") is not None:
        request.node.stash[_WATCH] = Watch(request.getfixturevalue("witness"))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A flight that failed while the machine gave nobody its time is skipped, and says so."""
    report = yield
    watch = item.stash.get(_WATCH, None)
    starved = watch.starved if watch is not None and report.failed else ""
    if starved:
        why = f"{starved}; it ended with: {call.excinfo.exconly()[:300]}"
        report.outcome = "skipped"
        report.longrepr = (str(item.path), item.location[1] or 0, f"Skipped: {why}")
    return report


@pytest.fixture(scope="session")
def rig() -> ModuleType:
    """The rig of tests/independent_rig_simulation.py, which shares no code with the project."""
    import independent_rig_simulation

    return independent_rig_simulation


@pytest.fixture
def no_warnings() -> Iterator[None]:
    """A figure that makes numpy or matplotlib warn hides something from its reader."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.fixture
def unwritten_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages have all figures, but as empty SVGs: writing one takes most of a page's time.

    For tests of words and numbers; other tests write the figures of the same pages.
    """
    from matplotlib.figure import Figure

    monkeypatch.setattr(Figure, "savefig", lambda _, file, **__: file.write("<svg></svg>"))


class Outcome(NamedTuple):
    """What a command left: its exit code and what it printed."""

    code: int
    out: str
    err: str


@pytest.fixture(scope="session")
def run_levid() -> Callable[..., int]:
    """A function that runs a command in this process and returns its exit code."""

    def run_levid(*arguments: object) -> int:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["levid", *map(str, arguments)])
            with pytest.raises(SystemExit) as ended:
                main()
        return int(ended.value.code or 0)

    return run_levid


@pytest.fixture
def levid(
    run_levid: Callable[..., int], capfd: pytest.CaptureFixture[str]
) -> Callable[..., Outcome]:
    """A function that runs a command and returns its outcome; no traceback ever reaches a user."""

    def levid(*arguments: object) -> Outcome:
        code = run_levid(*arguments)
        captured = capfd.readouterr()
        assert "Traceback" not in captured.err
        return Outcome(code, captured.out, captured.err)

    return levid


BUSES = {
    "can": """
can:
  main: {interface: virtual, channel: CHANNEL, bitrate: 1000000, stale_cycles: 2}
""",
    "canfd": """
can:
  main: {interface: virtual, channel: CHANNEL, bitrate: 1000000, data_bitrate: 5000000,
         stale_cycles: 2}
""",
    "canlocal": """
can:
  main: {interface: levid_local, channel: FOLDER/bus, bitrate: 1000000, data_bitrate: 5000000,
         stale_cycles: 2}
""",
    "serial": """
serial:
  main: {port: FOLDER/port, baud: 3000000, stale_cycles: 2}
""",
}


@pytest.fixture
def rig_on(tmp_path: Path, rig_in: Callable[..., RigConfig]) -> Callable[..., RigConfig]:
    """A function that returns the shipped rig on a bus (or loopback), at a rate, on a SIM.yaml."""
    return partial(rig_in, tmp_path)


@pytest.fixture(scope="session")
def rig_in() -> Callable[..., RigConfig]:
    """As `rig_on`, with the folder of the bus's sockets and ports as the first argument."""

    def rig_in(
        folder: Path, bus: str, rate_hz: float, sim: Path, expire_cycles: int = 2
    ) -> RigConfig:
        head = shipped("rigs/loopback.yaml").read_text().partition("amplifiers:")[0]
        backend = "can" if bus.startswith("can") else bus
        options = "" if bus == "loopback" else ", bus: main"
        expire = "" if bus == "loopback" else f", expire_cycles: {expire_cycles}"
        # Nothing is late because the machine is slow, or something is compiled.
        patient = ", heartbeat_s: 10, expire_s: 10" if backend == "can" else ""
        text = f"""{head}
amplifiers: {{backend: {backend}{options}{expire}}}
sensors: {{backend: {backend}{options}}}
drives: {{backend: {backend}{options}{patient}}}
sim: {sim}
{BUSES.get(bus, "").replace("CHANNEL", folder.name).replace("FOLDER", str(folder))}"""
        text = text.replace("rate_hz: 1000", f"rate_hz: {rate_hz}")
        return with_model(parse_text(text, RigConfig, bus), shipped("rigs/loopback.yaml"))

    return rig_in


class Patience:
    """Deadline of answers on a bus: `seconds` after SYNC, which a test may change at any time."""

    seconds = 100.0

    def deadline_s(self, now_s: float, _: float) -> float:
        return now_s + self.seconds


@pytest.fixture
def patience(monkeypatch: pytest.MonkeyPatch) -> Patience:
    """The deadline of all backends that the test opens; by default nothing is late."""
    patience = Patience()
    monkeypatch.setattr(AnswerTime, "of", lambda _: patience)
    return patience


@pytest.fixture
def host_paced(monkeypatch: pytest.MonkeyPatch, patience: Patience) -> None:
    """The host alone sets the pace, however slow the machine is: nothing on a bus is late.

    The electronics never go on by themselves, and the host waits for `patience`.
    """
    monkeypatch.setattr("levid.sim.electronics.emulated_devices._SILENT_PERIODS", 1e9)


@pytest.fixture
def quiet_sim(tmp_path: Path) -> Path:
    """The SIM.yaml of the declared model without any noise: equal commands, equal readings."""
    text = shipped("sims/nominal.yaml").read_text()
    for noisy in ("noise_n: 1e-3", "noise_m: 1e-7"):
        assert noisy in text
        text = text.replace(noisy, f"{noisy.partition(':')[0]}: 0")
    path = tmp_path / "quiet.yaml"
    path.write_text(text)
    return path
