"""Test the files of `levid install-service`: validity for systemd, replacement."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner

from levid.cli.main import levid
from levid.config.base import parse_text
from levid.config.daemon_settings import Live
from levid.config.rig import RigConfig, load_rig, model_path
from levid.config.shipped import shipped
from levid.daemon.service.service_files import (
    DROP_IN,
    NETWORK,
    SYSUSERS,
    UDEV,
    UNIT,
    _closed_folder,
    left_over,
    service_files,
    service_warnings,
    write,
)

PROGRAM = Path("/opt/levid/bin/levid")
RIG_FILE = Path("/etc/levid/rig.yaml")
SCORE = 2.0  # of systemd-analyze security: lower is better

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed"
)


def rig(kind: str, **replaced: str) -> RigConfig:
    text = shipped(f"rigs/{kind}.yaml").read_text()
    for old, new in replaced.items():
        assert old in text
        text = text.replace(old, new)
    return parse_text(text, RigConfig, kind)


def on_can() -> RigConfig:
    return rig("canfd", **{"udp_multicast": "socketcan", "239.74.163.4": "can0"})


def on_serial(port: str) -> RigConfig:
    return rig("serial", **{"/tmp/levid-electronics/main": port})


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["systemd-analyze", "--no-pager", *arguments], capture_output=True, text=True, check=False
    )


@needs_systemd
@pytest.mark.parametrize("kind", ["can", "serial", "loopback", "internet"])
def test_systemd_finds_nothing_wrong(kind: str, tmp_path: Path) -> None:
    found = {
        "can": on_can,
        "serial": lambda: on_serial("/dev/serial/by-id/usb-FTDI-if00"),
        "loopback": lambda: rig("loopback"),
        "internet": lambda: rig("canfd"),
    }[kind]()
    program = tmp_path / "a place" / "levid"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    write(service_files(found, tmp_path / "100 %.yaml", program), tmp_path, force=False)
    verified = analyze("verify", "--man=no", str(tmp_path / UNIT))
    said = [line for line in verified.stderr.splitlines() if "levid" in line]
    assert not said, verified.stderr
    judged = analyze(
        "security", "--offline=true", f"--threshold={10 * SCORE:g}", str(tmp_path / UNIT)
    )
    assert judged.returncode == 0, judged.stdout + judged.stderr
    assert "levid.service:" in judged.stdout


def test_the_unit_leaves_what_the_daemon_reads_of_the_machine() -> None:
    unit = service_files(rig("loopback"), RIG_FILE, PROGRAM)[UNIT]
    # /proc/stat and /proc/cpuinfo: what a host takes of its processors, and whether there is one.
    assert not [line for line in unit.splitlines() if line.startswith("ProcSubset=")]


def test_the_interface_gets_the_rigs_bitrates_and_comes_back() -> None:
    files = service_files(on_can(), RIG_FILE, PROGRAM)
    network = files[f"{NETWORK}can0.network"].splitlines()
    can = network[network.index("[CAN]") :]
    assert {"BitRate=1000000", "FDMode=yes", "DataBitRate=5000000", "RestartSec=100ms"} <= set(can)
    assert "OriginalName=can0" in files[f"{NETWORK}can0.link"]
    assert "AF_INET" not in files[DROP_IN]


def test_classic_can_has_no_data_phase() -> None:
    text = shipped("rigs/can.yaml").read_text()
    found = parse_text(text, RigConfig, "can")
    buses = {n: b.model_copy(update={"interface": "socketcan"}) for n, b in found.can.items()}
    buses = {
        n: b.model_copy(update={"channel": f"can{i}"}) for i, (n, b) in enumerate(buses.items())
    }
    files = service_files(found.model_copy(update={"can": buses}), RIG_FILE, PROGRAM)
    networks = [text for path, text in files.items() if path.endswith(".network")]
    assert len(networks) == len(buses)
    assert not any("FDMode" in text or "DataBitRate" in text for text in networks)


@pytest.mark.parametrize(
    ("port", "rule", "device"),
    [
        ("/dev/ttyUSB0", 'KERNEL=="ttyUSB[0-9]*"', "char-ttyUSB"),
        ("/dev/serial/by-id/usb-x", 'KERNEL=="ttyACM[0-9]*"', "char-ttyACM"),
        ("/dev/ttyAMA0", 'KERNEL=="ttyAMA0"', "/dev/ttyAMA0"),
    ],
)
def test_the_service_may_use_its_serial_port(port: str, rule: str, device: str) -> None:
    files = service_files(on_serial(port), RIG_FILE, PROGRAM)
    assert rule in files[UDEV]
    assert f"DeviceAllow={device} rw" in files[DROP_IN]


def on_slcan(channel: str) -> RigConfig:
    found = on_can()
    buses = {
        n: b.model_copy(update={"interface": "slcan", "channel": channel})
        for n, b in found.can.items()
    }
    return found.model_copy(update={"can": buses})


def test_the_service_may_use_a_can_adapter_on_a_port() -> None:
    found = on_slcan("/dev/ttyACM0@3000000")
    files = service_files(found, RIG_FILE, PROGRAM)
    assert 'KERNEL=="ttyACM[0-9]*"' in files[UDEV]
    assert "DeviceAllow=char-ttyACM rw" in files[DROP_IN]
    assert not [
        line for line in service_warnings(found, RIG_FILE, PROGRAM) if line.startswith("can.")
    ]


def test_what_a_can_adapter_on_usb_needs_is_told() -> None:
    found = on_slcan("0")
    buses = {n: b.model_copy(update={"interface": "gs_usb"}) for n, b in found.can.items()}
    found = found.model_copy(update={"can": buses})
    said = [line for line in service_warnings(found, RIG_FILE, PROGRAM) if line.startswith("can.")]
    assert len(said) == len(buses)
    assert all("DeviceAllow=char-usb_device rw" in line for line in said)


def test_the_watchdog_waits_for_what_the_rig_allows() -> None:
    found = rig("loopback")
    assert "Watchdog" not in service_files(found, RIG_FILE, PROGRAM)[DROP_IN]
    service = found.service.model_copy(update={"loop_s": 9.5, "supervisor_gone": "land"})
    found = found.model_copy(update={"service": service})
    unit = service_files(found, RIG_FILE, PROGRAM)[DROP_IN]
    assert "\nWatchdogSec=14\n" in unit
    assert "\nTimeoutAbortSec=60\n" in unit


def test_live_view_gets_local_ports_and_its_filter_of_system_calls() -> None:
    found = rig("loopback")
    assert "AF_INET" not in service_files(found, RIG_FILE, PROGRAM)[DROP_IN]
    unit = service_files(found.model_copy(update={"live": Live()}), RIG_FILE, PROGRAM)[DROP_IN]
    assert "\nRestrictAddressFamilies=AF_INET AF_INET6\nIPAddressAllow=localhost\n" in unit
    assert "\nSystemCallFilter=seccomp\n" in unit


def test_a_rig_without_ports_gets_the_right_to_none() -> None:
    files = service_files(rig("loopback"), RIG_FILE, PROGRAM)
    assert "tty" not in files[UDEV]
    assert "DeviceAllow" not in files[DROP_IN]
    assert set(files) == {UNIT, DROP_IN, SYSUSERS, UDEV}


def test_the_unit_runs_this_program_on_this_rig() -> None:
    files = service_files(rig("loopback"), Path("/srv/my rig/100%.yaml"), PROGRAM)
    assert 'ExecStart=/opt/levid/bin/levid run "/srv/my rig/100%%.yaml"' in files[DROP_IN]
    assert 'RequiresMountsFor="/srv/my rig/100%%.yaml"\n' in files[DROP_IN]
    assert files[UNIT].endswith(shipped("levid.service").read_text())


def test_service_waits_for_the_model_and_warns_if_it_cannot_read_it(tmp_path: Path) -> None:
    folder = tmp_path / "closed"
    folder.mkdir(mode=0o700)
    (folder / "model.yaml").write_text(shipped("models/rig.yaml").read_text())
    rig_file = tmp_path / "rig.yaml"
    text = shipped("rigs/loopback.yaml").read_text()
    assert "../models/rig.yaml" in text
    rig_file.write_text(text.replace("../models/rig.yaml", "closed/model.yaml"))
    found, model = load_rig(rig_file), model_path(rig_file)
    assert model == folder / "model.yaml"
    files = service_files(found, rig_file, PROGRAM, model)
    assert f'RequiresMountsFor="{model}"\n' in files[DROP_IN]
    warnings = service_warnings(found, rig_file, PROGRAM, model)
    assert any(line.startswith(f"{model}: user levid has no access to") for line in warnings)


def install(root: Path, *more: str) -> tuple[int, str]:
    rig_file = str(shipped("rigs/serial.yaml"))
    result = CliRunner().invoke(
        levid, ["install-service", rig_file, "--root", str(root), *more], standalone_mode=False
    )
    said = result.output + (str(result.exception) if result.exception else "")
    return int(result.exception is not None), said


def test_a_second_time_changes_nothing(tmp_path: Path) -> None:
    assert install(tmp_path)[0] == 0
    failed, said = install(tmp_path)
    assert not failed
    assert said.count(": unchanged") == 4
    assert "next: systemd-sysusers" in said


def test_a_dry_run_writes_nothing(tmp_path: Path) -> None:
    failed, said = install(tmp_path, "--dry-run")
    assert not failed
    assert "Type=notify" in said
    assert f"{UNIT}: new" in said
    assert not list(tmp_path.iterdir())


def test_files_of_another_version_are_written_anew(tmp_path: Path) -> None:
    write(service_files(rig("loopback"), RIG_FILE, PROGRAM), tmp_path, force=False)
    done = write(service_files(on_serial("/dev/ttyS0"), RIG_FILE, PROGRAM), tmp_path, force=False)
    assert done[DROP_IN] == "updated"
    assert "ttyS0" in (tmp_path / UDEV).read_text()


def test_what_was_changed_by_hand_stays(tmp_path: Path) -> None:
    install(tmp_path)
    unit = tmp_path / UNIT
    (tmp_path / SYSUSERS).unlink()
    unit.write_text(unit.read_text().replace("WatchdogSec=5", "WatchdogSec=50"))
    failed, said = install(tmp_path)
    assert failed
    assert str(unit) in said
    assert "WatchdogSec=50" in unit.read_text()
    assert not (tmp_path / SYSUSERS).exists(), "nothing is written if not all of it is"
    assert install(tmp_path, "--force")[0] == 0
    assert "WatchdogSec=50" not in unit.read_text()
    assert "WatchdogSec=50" in unit.with_name("levid.service.old").read_text()


def test_a_folder_that_others_may_not_enter_is_found(tmp_path: Path) -> None:
    home = tmp_path / "me"
    home.mkdir()
    tmp_path.chmod(0o755)
    tmp_path.parent.chmod(0o755)
    home.chmod(0o750)
    assert _closed_folder(home / "rig.yaml") in (home, *tmp_path.parents)
    home.chmod(0o751)
    assert _closed_folder(home / "rig.yaml") != home


def test_an_adapter_that_is_plugged_in_already_gets_its_latency() -> None:
    # `udevadm trigger` replays changes, not additions.
    rules = service_files(on_serial("/dev/ttyUSB0"), RIG_FILE, PROGRAM)[UDEV]
    assert 'ACTION!="remove", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio"' in rules


def test_drivers_of_usb_ports_are_there_before_their_classes_are_looked_up() -> None:
    unit = service_files(on_serial("/dev/ttyUSB0"), RIG_FILE, PROGRAM)[DROP_IN]
    for driver in ("usbserial", "cdc_acm"):
        assert f"Wants=modprobe@{driver}.service\nAfter=modprobe@{driver}.service\n" in unit
    unit = service_files(on_serial("/dev/ttyAMA0"), RIG_FILE, PROGRAM)[DROP_IN]
    assert "After=dev-ttyAMA0.device\n" in unit
    assert "modprobe" not in unit


def test_a_name_that_udev_made_is_a_link_wherever_it_lies() -> None:
    files = service_files(on_serial("/dev/levid_amps"), RIG_FILE, PROGRAM)
    assert 'KERNEL=="ttyUSB[0-9]*"' in files[UDEV]
    assert "levid_amps" not in files[UDEV]
    assert "DeviceAllow=char-ttyACM rw" in files[DROP_IN]


def test_an_adapter_that_is_missing_keeps_nobody_waiting_for_minutes() -> None:
    files = service_files(on_can(), RIG_FILE, PROGRAM)
    unit = "systemd-networkd-wait-online@can0.service"
    assert f"After={unit}" in files[DROP_IN]
    assert "TimeoutStartSec=20" in files[f"etc/systemd/system/{unit}.d/10-levid.conf"]


def test_files_of_the_rig_before_are_named(tmp_path: Path) -> None:
    write(service_files(on_can(), RIG_FILE, PROGRAM), tmp_path, force=False)
    by_hand = tmp_path / f"{NETWORK}can0.link"
    by_hand.write_text(by_hand.read_text() + "# mine\n")
    now = service_files(rig("loopback"), RIG_FILE, PROGRAM)
    waits = "etc/systemd/system/systemd-networkd-wait-online@can0.service.d/10-levid.conf"
    assert left_over(now, tmp_path) == [tmp_path / f"{NETWORK}can0.network", tmp_path / waits]
    assert left_over(service_files(on_can(), RIG_FILE, PROGRAM), tmp_path) == []


def test_a_rig_that_the_daemon_would_refuse_is_told(tmp_path: Path) -> None:
    text = shipped("rigs/loopback.yaml").read_text()
    found = parse_text(text.replace("../sims/nominal.yaml", "nowhere.yaml"), RigConfig, "rig")
    said = list(service_warnings(found, tmp_path / "rig.yaml", PROGRAM))
    assert any("will not start" in line and "nowhere.yaml" in line for line in said)


def test_users_that_are_not_there_are_told() -> None:
    found = load_rig(shipped("rigs/loopback.yaml"))
    service = found.service.model_copy(update={"allow_users": ["nobody-such"]})
    found = found.model_copy(update={"service": service})
    said = list(service_warnings(found, shipped("rigs/loopback.yaml"), PROGRAM))
    assert any("will not start" in line and "nobody-such" in line for line in said)


def test_networkd_is_named_only_where_there_is_something_for_it(tmp_path: Path) -> None:
    assert "networkctl" not in install(tmp_path)[1]


def test_the_unit_limits_memory_and_tasks() -> None:
    unit = service_files(rig("loopback"), RIG_FILE, PROGRAM)[UNIT].splitlines()
    limits = dict(line.split("=", 1) for line in unit if line.startswith(("MemoryMax", "TasksMax")))
    assert limits.keys() == {"MemoryMax", "TasksMax"}
    # Else a planner's child that the kernel kills for its memory would end the flight.
    assert "OOMPolicy=continue" in unit


def test_the_service_may_write_the_logs_where_the_rig_wants_them() -> None:
    found = rig("loopback")
    for root, written in (
        ("/data/levid flights", ['ReadWritePaths="-/data/levid flights"']),
        ("/var/lib/levid/sessions", []),
        (None, []),
    ):
        recording = found.recording.model_copy(update={"root": root})
        other = found.model_copy(update={"recording": recording})
        drop_in = service_files(other, RIG_FILE, PROGRAM)[DROP_IN].splitlines()
        assert [line for line in drop_in if line.startswith("ReadWritePaths")] == written


def test_group_members_cannot_decide_what_the_daemon_executes() -> None:
    """Members write to the state folder: nothing that is executed may come from there."""
    unit = shipped("levid.service").read_text().splitlines()
    keys = dict(line.split("=", 1) for line in unit if "=" in line and not line.startswith("#"))
    variables = dict(pair.split("=", 1) for pair in keys["Environment"].split())
    assert keys["UMask"] == "0007"
    assert keys["CacheDirectoryMode"] == "0700"
    private = f"/var/cache/{keys['CacheDirectory']}"
    assert variables["NUMBA_CACHE_DIR"] == variables["HOME"] == private
    assert variables["PYTHONSAFEPATH"] == variables["PYTHONNOUSERSITE"] == "1"
    assert "WorkingDirectory" not in keys  # which is /
