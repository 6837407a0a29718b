"""Test that the commands which levid prints run as they are printed, in a folder with a space."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from printed_lines import asks_for_a_value, commands, commands_of_page, expanded

Run = Callable[[str], list[str]]

SESSION = """
levid: session
name: short
excitations:
  z: {input: z, rms_n: 1.0}
steps:
  - levitate: {settle_s: 1.0}
  - record: {name: noise, excite: [z], duration_s: 4, settle_s: 0}
  - record: {name: more, excite: [z], duration_s: 4, settle_s: 0}
  - land: {}
"""
MODEL = """
levid: model
name: drive
dof: [{name: x_m, unit: m}]
inputs: [{name: u_n, unit: N}]
parameters:
  m: {value: 1.0, unit: kg, min: 0.01, max: 100}
  d: {value: 2.0, unit: N s/m, min: 0, max: 1000}
  k: {value: 50.0, unit: N/m, min: 0, max: 10000}
M: [[m]]
D: [[d]]
K: [[k]]
"""


@pytest.fixture
def run(levid: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run a line as bash would, and return the commands that it prints as next."""
    folder = tmp_path / "my data"
    folder.mkdir()
    monkeypatch.chdir(folder)

    def run(line: str) -> list[str]:
        outcome = levid(*expanded(line, folder))
        assert outcome.code == 0, f"{line}\n{outcome.err}"
        return commands(f"{outcome.out}\n{outcome.err}")

    return run


def drive_table() -> str:
    """Return a CSV table of the mass on a spring of MODEL, driven by white noise at 200 Hz."""
    rng, Ts_s, x, v, rows = np.random.default_rng(1), 0.005, 0.0, 0.0, ["u_n,x_m"]
    for u in rng.normal(0.0, 1.0, 2000):
        v += Ts_s * (u - 2.0 * v - 50.0 * x)
        x += Ts_s * v
        rows.append(f"{u:.9g},{x + rng.normal(0.0, 1e-5):.9g}")
    return "\n".join(rows) + "\n"


@pytest.mark.parametrize(
    "line",
    [
        "levid new rig serial -o 'my rig.yaml'",
        "levid new session gains -o -gains.yaml",
        "levid new model rig-gains",
        "levid new sim undeclared",
        "levid new signals silverbox",
    ],
)
def test_next_command_after_a_copy_of_a_shipped_file(run: Run, line: str) -> None:
    (check,) = run(line)
    run(check)


@pytest.mark.usefixtures("unwritten_figures")
def test_next_commands_from_a_table_to_a_model(run: Run) -> None:
    Path("my drive.csv").write_text(drive_table())
    Path("MODEL.yaml").write_text(MODEL)
    drafted = run("levid new signals 'my drive.csv'")
    draft = Path("my drive.yaml")  # as the reader completes it
    text = draft.read_text()
    draft.write_text(
        "levid: signals\nname: drive\nrate_hz: 200\ncolumns:\n"
        "  - {column: u_n, name: u_n, unit: N, role: input}\n"
        "  - {column: x_m, name: x_m, unit: m, role: output}\n"
    )
    assert text
    (line,) = drafted
    black_box, fitted, traced = run(line)
    assert not asks_for_a_value(black_box)
    assert all(asks_for_a_value(line) for line in (fitted, traced))
    run(black_box)
    for line in commands_of_page(Path("my drive/index.html")):
        run(line)
    run(fitted)
    for line in commands_of_page(Path("my drive/index.html")):
        if not line.startswith("levid trace"):  # takes long; `traced` is the same command
            run(line)


@pytest.mark.usefixtures("unwritten_figures")
def test_next_commands_after_a_flight_of_the_shipped_rig(run: Run) -> None:
    Path("short.yaml").write_text(SESSION)
    (identify,) = run("levid excite short.yaml --virtual --out 'out 1/first'")
    assert commands_of_page(Path("out 1/first/report/index.html")) == [
        identify.replace("'out 1/first", f"'{Path('out 1/first').absolute()}")
    ] or commands_of_page(Path("out 1/first/report/index.html")) == [identify]
    run(identify)
    lines = commands_of_page(Path("out 1/first/identification/index.html"))
    assert lines
    for line in lines:
        assert not asks_for_a_value(line)
        if line.startswith("levid excite"):  # of a shipped session: minutes of flight
            assert "--virtual" in line
            run(line.replace("excite", "check").partition(" --virtual")[0])
        elif not line.startswith("levid trace"):
            run(line)


@pytest.mark.usefixtures("unwritten_figures")
def test_pages_of_another_rig_suggest_no_session_of_the_shipped_one(run: Run) -> None:
    Path("short.yaml").write_text(SESSION)
    run("levid new rig loopback -o mine.yaml")
    (identify,) = run("levid excite short.yaml --virtual --rig mine.yaml --out out")
    run(identify)
    lines = commands_of_page(Path("out/identification/index.html"))
    assert not [line for line in lines if line.startswith("levid excite")]
