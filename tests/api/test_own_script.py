"""Test a user's script that traces a flight of a plant with an effect of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import yaml

from levid.config.shipped import shipped

Command = Callable[..., tuple[int, str, str]]
SCRIPT = """
import json
import levid

open("starts.txt", "a").write("started\\n")
record = {"excite": ["psi", "theta", "z"], "each_s": 5, "settle_s": 1}
session = {
    "levid": "session", "name": "pad", "seed": 5,
    "excitations": {
        "psi": {"input": "psi", "rms_n_m": 0.3},
        "theta": {"input": "theta", "rms_n_m": 0.3},
        "z": {"input": "z", "rms_n": 2.5},
    },
    "steps": [
        {"levitate": {"settle_s": 1}},
        {"record": {"name": "still", "duration_s": 6, "settle_s": 1}},
        {"record": {"name": "first", **record}},
        {"record": {"name": "second", **record}},
        {"land": {}},
    ],
}
flight = levid.fly(session, sim="sim.yaml", out="logs")
trace = flight.trace(workers=2)
trace.plot()
trace.plot(0).savefig("effect.png")
trace.report("found")
json.dump(trace.to_json(), open("trace.json", "w"))
"""


def test_script_without_a_check_of_name_runs_once_and_equals_the_command(
    tmp_path: Path, levid: Command
) -> None:
    sim = yaml.safe_load(shipped("sims/nominal.yaml").read_text())
    cubic = {"use": "levid.sim.effects.stiffness:CubicRods", "dof": "z", "k3_n_m3": 6e8}
    (tmp_path / "sim.yaml").write_text(yaml.safe_dump({**sim, "effects": [cubic]}))
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    # Worker processes import a script again, unless levid prevents it.
    assert (tmp_path / "starts.txt").read_text().count("started") == 1
    assert "lost a worker" not in done.stderr
    assert (tmp_path / "effect.png").stat().st_size > 10_000
    own = json.loads((tmp_path / "trace.json").read_text())
    assert own["effects"][0]["class"] == "rod_stiffness"

    logs = sorted((tmp_path / "logs").glob("*.mcap"))
    code, out, _ = levid("trace", *logs, "--out", tmp_path / "out", "--json", "--workers", 1)
    assert code == 0
    paths = {"model": None, "report": None}
    assert {**own, **paths} == {**json.loads(out), **paths}
