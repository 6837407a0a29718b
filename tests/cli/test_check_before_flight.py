"""Test `levid check` on what would fail later, and `levid check --preflight`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from levid.config.shipped import shipped

SESSION = """
levid: session
name: long
excitations: {psi: {input: psi, rms_n_m: 0.05}}
steps:
  - levitate: {}
  - record: {name: tilt, duration_s: DURATION, excite: [psi]}
  - land: {}
"""
MODEL = """
levid: model
name: m
dof: [{name: x, unit: m}, {name: y, unit: m}]
inputs: [{name: a, unit: N}, {name: b, unit: N}]
parameters: {m: {value: 1, unit: kg}}
M: [[m, COUPLING], [COUPLING, m]]
D: [[0, 0], [0, 0]]
K: [[1, 0], [0, 1]]
B: [[1, 0], [0, 1]]
"""


def test_session_that_no_daemon_flies_is_rejected_before_it_is_planned(
    levid, tmp_path: Path
) -> None:
    path = tmp_path / "long.yaml"
    path.write_text(SESSION.replace("DURATION", "86400"))
    outcome = levid("check", path)
    assert outcome.code == 1
    assert "expected a total of at most 30000 s at 1000 Hz, found 86" in outcome.err


@pytest.mark.parametrize(("coupling", "code"), [("0.5*m", 0), ("2*m", 1), ("m", 1)])
def test_mass_that_is_not_positive_is_rejected(
    levid, tmp_path: Path, coupling: str, code: int
) -> None:
    path = tmp_path / "model.yaml"
    path.write_text(MODEL.replace("COUPLING", coupling))
    outcome = levid("check", path)
    assert outcome.code == code
    assert not code or "M" in outcome.err


@pytest.fixture
def no_daemon(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)


@pytest.mark.usefixtures("no_daemon")
def test_preflight_lists_each_check(levid, tmp_path: Path) -> None:
    session = tmp_path / "short.yaml"
    session.write_text(SESSION.replace("DURATION", "2"))
    outcome = levid(
        "check", "--preflight", shipped("rigs/loopback.yaml"), session, "--out", tmp_path / "new"
    )
    assert not (tmp_path / "new").exists()
    lines = {line.split()[1]: line.split()[0] for line in outcome.out.splitlines() if "  " in line}
    assert lines.keys() >= {"devices", "recorder", "real_time", "cpu", "loop", "motion", "disk"}
    assert (lines["loop"], lines["motion"], lines["disk"]) == ("ok", "ok", "ok")
    assert lines["recorder"] == "unknown"
    assert outcome.code == (1 if lines["real_time"] == "FAILED" else 0)


@pytest.mark.usefixtures("no_daemon")
def test_preflight_fails_for_a_loop_near_its_limit(levid, tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    text = shipped("rigs/loopback.yaml").read_text()
    for gain in ("kp_n_m_rad: 20,", "ki_n_m_rad_s: 200}", "kp_n_m: 500,", "ki_n_m_s: 3000}"):
        assert gain in text
        number = gain.split(": ")[1].strip(",}")
        text = text.replace(gain, gain.replace(number, str(3 * int(number))))
    folder = shipped("rigs/loopback.yaml").parent.parent
    rig.write_text(text.replace("../", f"{folder}/"))
    outcome = levid("check", "--preflight", rig)
    assert outcome.code == 1
    assert "FAILED  loop" in outcome.out
    assert "lower the gains" in outcome.out
    missing = tmp_path / "no-port.yaml"
    text = shipped("rigs/serial.yaml").read_text().replace("../", f"{folder}/")
    missing.write_text(text.replace("/tmp/levid-electronics/main", str(tmp_path / "port")))
    outcome = levid("check", "--preflight", missing)
    assert "FAILED  devices" in outcome.out
    assert f"no port {tmp_path / 'port'}" in outcome.out


def test_check_as_json_has_one_object_a_file(levid, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("levid: session\nname: wrong\nsteps: 3\n")
    outcome = levid("check", "--json", shipped("models/rig.yaml"), wrong)
    right, bad = json.loads(outcome.out)["files"]
    assert outcome.code == 1
    assert (right["usable"], bad["usable"], bad["file"]) == (True, False, str(wrong))
    assert right["found"].startswith("model, 3 DOF")
    assert "steps" in bad["found"]


@pytest.mark.usefixtures("no_daemon")
def test_preflight_as_json(levid, tmp_path: Path) -> None:
    session = tmp_path / "short.yaml"
    session.write_text(SESSION.replace("DURATION", "2"))
    rig = shipped("rigs/loopback.yaml")
    outcome = levid("check", "--preflight", "--json", rig, session, "--out", tmp_path)
    found = json.loads(outcome.out)
    assert found.keys() == {str(rig), str(session)}
    outcomes = {f["check"]: f["outcome"] for f in found[str(session)]}
    assert outcomes == {"motion": "passed", "disk": "passed"}


def test_preflight_wants_rigs_and_sessions(levid) -> None:
    assert levid("check", "--preflight", shipped("models/rig.yaml")).code == 2
