"""Test the command line: help, exit codes, one-line errors instead of tracebacks."""

import re
from pathlib import Path

import numpy as np
import pytest

from levid.cli.check import _periods
from levid.config.command_line import command_line
from levid.config.shipped import shipped
from levid.daemon.recording.post_processing import HandoverError
from levid.log.reader import read_log

SESSION = """
levid: session
name: short
excitations:
  psi: {input: psi, rms_n_m: 0.1}
steps:
  - levitate: {settle_s: 0.5}
  - record: {name: tilt, duration_s: 2, settle_s: 0.5, excite: [psi]}
  - land: {}
"""
VERBS = ["check", "run", "excite", "status", "land", "clear", "identify", "new", "import", "demo"]


@pytest.fixture
def session(tmp_path: Path) -> Path:
    path = tmp_path / "session.yaml"
    path.write_text(SESSION)
    return path


@pytest.mark.parametrize("verb", VERBS)
def test_help_ends_with_examples(levid, verb: str) -> None:
    outcome = levid(verb, "--help")
    assert outcome.code == 0
    assert re.search(rf"Examples:\n\s+levid {verb}", outcome.out)


def test_help_names_every_verb(levid) -> None:
    outcome = levid("--help")
    assert all(re.search(rf"^\s+{verb}\s", outcome.out, re.M) for verb in VERBS)


@pytest.mark.parametrize("arguments", [["fly"], ["excite"], ["check"], ["excite", "x", "--level"]])
def test_wrong_usage_gives_exit_code_2(levid, arguments: list[str]) -> None:
    outcome = levid(*arguments)
    assert outcome.code == 2
    assert "Usage:" in outcome.err


def test_check_accepts_good_files_and_reports_bad_ones(levid, tmp_path: Path) -> None:
    good = shipped("rigs/loopback.yaml")
    assert levid("check", good).code == 0
    bad = tmp_path / "bad.yaml"
    bad.write_text(good.read_text().replace("coil_n: 20", "coil_n: many"))
    outcome = levid("check", good, bad, tmp_path / "none.yaml")
    assert outcome.code == 1
    assert f"{good}: rig, 9 coils" in outcome.out
    assert f"{bad}: limits.coil_n: expected a" in outcome.err
    assert "none.yaml: cannot be read" in outcome.err


def test_check_reports_a_session_that_the_rig_cannot_fly(levid, tmp_path: Path) -> None:
    path = tmp_path / "loud.yaml"
    path.write_text(SESSION.replace("rms_n_m: 0.1", "rms_n_m: 10"))
    outcome = levid("check", path)
    assert outcome.code == 1
    assert "would saturate the coils" in outcome.err


def test_check_reports_a_rig_with_its_sensors_on_one_line(levid, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    text = shipped("rigs/loopback.yaml").read_text()
    path.write_text(
        text.replace(
            "control:", "  sensor_x_m: [0, 0.1, 0.2]\n  sensor_y_m: [0, 0.1, 0.2]\ncontrol:"
        )
    )
    outcome = levid("check", path)
    assert outcome.code == 1
    assert "not on one line" in outcome.err


def test_check_reads_logs(levid, session: Path, tmp_path: Path) -> None:
    levid("excite", session, "--virtual", "--out", tmp_path / "out")
    log = tmp_path / "out" / "01-tilt.mcap"
    assert "log, 2500 rows at 1000 Hz (2.5 s)" in levid("check", log).out
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[: log.stat().st_size * 3 // 4])
    outcome = levid("check", cut)
    assert outcome.code == 0
    assert "truncated, these rows can be read: byte" in outcome.out
    empty = tmp_path / "empty.mcap"
    empty.touch()
    assert levid("check", empty).code == 1


@pytest.mark.parametrize(
    ("cycles", "kind"),
    [
        ([[0, 0], [1, 1], [2, 2]], "2<u8"),
        ([True, False, True], "?"),
        ([9, 5, 2], "<u8"),
        ([250, 255, 4], "<u1"),
        ([np.nan, 1.0, 2.0], "<f8"),
    ],
)
def test_check_ignores_a_cycle_field_that_is_not_a_counter(cycles, kind) -> None:
    dtype = np.dtype([("y", "<f8"), ("cycle", kind)])
    rows = np.zeros(3, dtype)
    rows["cycle"] = cycles
    assert _periods(rows) == 0  # the duration then follows from the number of rows


def test_excite_flies_and_never_overwrites(levid, session: Path, tmp_path: Path) -> None:
    outcome = levid("excite", session, "--virtual", "--out", tmp_path / "out")
    assert outcome.code == 0
    assert "next: levid identify" in outcome.err
    before = (tmp_path / "out" / "01-tilt.mcap").read_bytes()
    again = levid("excite", session, "--virtual", "--out", tmp_path / "out")
    assert again.code == 1
    assert "never overwritten" in again.err
    assert (tmp_path / "out" / "01-tilt.mcap").read_bytes() == before


def test_excite_flies_another_simulator_with_an_undeclared_effect(
    levid, session: Path, tmp_path: Path
) -> None:
    (tmp_path / "wind.py").write_text(
        "import numpy as np\n"
        "class Wind:\n"
        "    def __init__(self, force_n): self.force_n = force_n\n"
        "    def wrench(self, t_s, q, qd, beam): return np.array([0.0, 0.0, self.force_n])\n"
    )
    sim = tmp_path / "sim.yaml"
    sim.write_text(
        shipped("sims/nominal.yaml")
        .read_text()
        .replace("effects: []", 'effects: [{use: "wind.py:Wind", force_n: 0.5}]')
    )
    outcome = levid("excite", session, "--sim", sim, "--virtual", "--out", tmp_path / "out")
    assert outcome.code == 0, outcome.err
    rows = read_log(tmp_path / "out" / "01-tilt.mcap").rows
    # The integrator settles to -0.5 N, the force of the wind. After 1 s of settling with its slow
    # pole (1 rad/s) the error is below half of that; noise is of the order of mN.
    pi = np.mean((rows["tau_z_n"] - rows["ff_z_n"] - rows["v_z_n"])[-500:])
    assert -0.6 < pi < -0.2


def test_check_loads_effects(levid, tmp_path: Path) -> None:
    sim = tmp_path / "sim.yaml"
    text = shipped("sims/nominal.yaml").read_text()
    sim.write_text(text.replace("effects: []", 'effects: [{use: "nowhere.py:Wind"}]'))
    outcome = levid("check", sim)
    assert outcome.code == 1
    assert "nowhere.py" in outcome.err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("effects: []", 'effects: [{use: "nowhere.py:Wind"}]'), "nowhere.py"),
        (("seed: 1", "seed: one"), "seed: expected a"),
        (("plant: declared", "plant: real"), "plant: expected"),
    ],
)
def test_bad_simulator_file_is_reported(
    levid, session: Path, tmp_path: Path, change: tuple[str, str], message: str
) -> None:
    sim = tmp_path / "sim.yaml"
    sim.write_text(shipped("sims/nominal.yaml").read_text().replace(*change))
    outcome = levid("excite", session, "--sim", sim, "--virtual", "--out", tmp_path / "out")
    assert outcome.code == 1
    assert message in outcome.err
    assert "sim.yaml" in outcome.err
    assert not (tmp_path / "out").exists()


def test_excite_without_a_daemon_prints_how_to_start_one(
    levid, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    outcome = levid("excite", session, "--out", tmp_path / "out")
    assert outcome.code == 1
    assert "levid run RIG.yaml" in outcome.err
    assert levid("excite", session, "--sim", "x", "--out", tmp_path / "out").code == 2


def test_check_reports_the_rig_with_a_missing_simulator_file(levid, tmp_path: Path) -> None:
    text = shipped("rigs/loopback.yaml").read_text()
    (tmp_path / "rig.yaml").write_text(text)
    outcome = levid("check", tmp_path / "rig.yaml")
    assert outcome.code == 1
    assert outcome.err.startswith(f"{tmp_path}/rig.yaml: ")
    assert "nominal.yaml" in outcome.err


def test_out_that_is_a_file_is_rejected(levid, session: Path) -> None:
    outcome = levid("excite", session, "--virtual", "--out", session)
    assert outcome.code == 1
    assert "expected a folder, found a file" in outcome.err


def test_check_validates_the_effects_of_a_model(tmp_path: Path, levid) -> None:
    path, model = tmp_path / "model.yaml", shipped("models/rig.yaml").read_text()
    cubic = (
        "{effect: rod_stiffness.cubic, where: [WHERE], "
        "parameters: {k3: {value: 3.0e8, unit: N/m^3}}}"
    )
    path.write_text(f"{model}\neffects:\n- {cubic.replace('WHERE', 'z')}\n")
    assert "parameters, 1 effect" in levid("check", path).out
    path.write_text(f"{model}\neffects:\n- {cubic.replace('WHERE', 'x')}\n")
    outcome = levid("check", path)
    assert outcome.code == 1
    assert "model.yaml: effects[0]: where: expected one of psi, theta, z" in outcome.err


def test_then_commands_run_although_an_earlier_one_failed(
    levid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    called = []

    def hand_over(verb: str, records: list[Path], out: Path) -> None:
        called.append((verb, out.name))
        if verb == "identify":
            raise HandoverError("levid identify of 1 records failed")

    monkeypatch.setattr("levid.daemon.recording.post_processing.hand_over", hand_over)
    path, out = tmp_path / "session.yaml", tmp_path / "out"
    path.write_text(f"{SESSION}\nthen: [identify, trace]\n")
    outcome = levid("excite", path, "--virtual", "--out", out)
    assert outcome.code == 1
    assert called == [("identify", "identification"), ("trace", "trace")]
    assert "error: levid identify of 1 records failed" in outcome.err
    logs = sorted(out.glob("*.mcap"))
    again = command_line("identify", logs=logs, out=out / "identification")
    assert f"to repeat it: {again}" in outcome.err
