"""Test that a restarted daemon continues with the saved coil heat."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from levid.config.rig import RigConfig, load_rig
from levid.config.shipped import shipped
from levid.daemon.recording import coil_heat_file as heat_module
from levid.daemon.recording.coil_heat_file import HeatFile, state_folder

RIG = load_rig(shipped("rigs/loopback.yaml"))
LIMITED = RIG.model_copy(update={"limits": RIG.limits.model_copy(update={"coil_rms_n": 8.0})})


class Machine:
    """The clocks of a machine and its boot id."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.boot, self.uptime_s, self.time_s = "one", 100.0, 1e9
        monkeypatch.setattr(heat_module, "_now", lambda: dict(vars(self)))


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(monkeypatch)


def kept(folder: Path, heat: np.ndarray, rig: RigConfig = LIMITED) -> None:
    at, heated = np.zeros(9), np.zeros(1)
    file = HeatFile(rig, folder, at, heated)
    file.start()
    at[:], heated[:] = heat, 1.0  # as a flying daemon does
    file.close(10.0)


def taken_over(folder: Path, said: list[str] | None = None) -> np.ndarray:
    heat = np.zeros(9)
    file = HeatFile(LIMITED, folder, heat, np.zeros(1), [].append if said is None else said.append)
    file.start()
    found = heat.copy()
    file.close(10.0)
    return found


def test_saved_heat_cools_down_by_the_uptime_since(tmp_path: Path, machine: Machine) -> None:
    hot = np.arange(9.0) * 7.0
    kept(tmp_path, hot)
    machine.uptime_s += 60.0
    machine.time_s -= 5000.0  # the clock was set: the uptime counts
    np.testing.assert_allclose(taken_over(tmp_path), hot * math.exp(-1.0))


def test_after_a_boot_heat_cools_down_by_the_time_of_day(tmp_path: Path, machine: Machine) -> None:
    hot = np.full(9, 50.0)
    kept(tmp_path, hot)
    machine.boot, machine.uptime_s, machine.time_s = "two", 1.0, 1e9 - 10.0
    np.testing.assert_allclose(taken_over(tmp_path), hot)
    kept(tmp_path, hot)
    machine.boot, machine.time_s = "three", machine.time_s + 120.0
    np.testing.assert_allclose(taken_over(tmp_path), hot * math.exp(-2.0))


def test_without_a_limit_there_is_no_file(tmp_path: Path) -> None:
    free = RIG.model_copy(update={"limits": RIG.limits.model_copy(update={"coil_rms_n": None})})
    kept(tmp_path, np.full(9, 50.0), free)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", '{"heat_n2": "hot"}', json.dumps({"heat_n2": [1e9] * 9}),
     json.dumps({"heat_n2": [math.nan] * 9}), json.dumps({"heat_n2": [1.0] * 8})],
)  # fmt: skip
def test_invalid_file_is_reported_and_replaced(tmp_path: Path, text: str, machine: Machine) -> None:
    kept(tmp_path, np.full(9, 50.0))
    (path,) = tmp_path.iterdir()
    path.write_text(text)
    said: list[str] = []
    assert (taken_over(tmp_path, said) == 64.0).all()  # at the limit
    assert "cannot read the coil heat" in said[0]
    assert json.loads(path.read_text())["boot"] == machine.boot


def test_failing_folder_is_reported_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    said: list[str] = []
    file = HeatFile(
        LIMITED, tmp_path / "file" / "below", np.full(9, 50.0), np.zeros(1), said.append
    )
    file.start()
    file.save()
    file.close(10.0)
    assert len([line for line in said if "cannot save" in line]) == 1


def test_unknown_boot_is_not_the_same_boot(tmp_path: Path, machine: Machine) -> None:
    """After a reboot the uptime is smaller than before: the coils would not cool down."""
    machine.boot = ""
    kept(tmp_path, np.full(9, 50.0))
    machine.uptime_s, machine.time_s = 1.0, machine.time_s + 60.0
    np.testing.assert_allclose(taken_over(tmp_path), 50.0 * math.exp(-1.0))


def test_file_keeps_the_time_of_its_heat_without_new_cycles(
    tmp_path: Path, machine: Machine
) -> None:
    """Otherwise coils are as hot after a weekend without a link as before it."""
    file = HeatFile(LIMITED, tmp_path, np.full(9, 60.0), np.full(1, 1000.0))
    file.save()
    machine.uptime_s += 120.0
    file.save()
    file.start()
    file.close(10.0)
    np.testing.assert_allclose(taken_over(tmp_path), 60.0 * math.exp(-2.0))


def test_failed_write_does_not_leave_a_colder_file(
    tmp_path: Path, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    heat, heated = np.full(9, 5.0), np.zeros(1)
    file = HeatFile(LIMITED, tmp_path, heat, heated)
    assert file.save()
    (path,) = tmp_path.iterdir()
    with monkeypatch.context() as patched:
        patched.setattr(heat_module.os, "fsync", full)
        heated[:] = 1.0
        assert not file.save()
        assert path.stat().st_size > 0, "it says what is so"
        heat[:] = 60.0
        assert not file.save()
    assert [path] == list(tmp_path.iterdir())
    said: list[str] = []
    assert (taken_over(tmp_path, said) == 64.0).all()
    assert "heat limit" in said[0]
    assert file.save()  # as soon as there is room
    np.testing.assert_allclose(taken_over(tmp_path), 60.0)


def test_service_uses_its_state_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/levid:/var/lib/other")
    assert state_folder() == Path("/var/lib/levid")
