"""Test the examples of CONTRIBUTING.md: apply them to a copy of the repository and run it."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from repository_folders import ROOT

from levid.log.reader import read_log

BLOCK = re.compile(r"^```(\w+) file=(\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SESSION = """levid: session
name: lift
seed: 1
steps:
  - levitate: {}
  - record: {name: rest, duration_s: 2}
  - land: {}
"""
TRAJECTORY = """
import numpy as np
from levid.model.effects.base import Signals
from levid.model.effects.candidate_effects import all_effects
from levid.sim.effects.quintic import QuinticRods
from effect_test_helpers import moving, rig_places

signals = moving()
(effect,) = (e for e in all_effects(rig_places()) if e.identity == "rod_stiffness.quintic@z")
(term,) = effect.build(signals, ())
rods = QuinticRods("z", 2.0)
simulated = [rods.force(z, 0.0) for z in signals.q[:, 2]]
np.testing.assert_allclose(2.0 * term.force[:, 2], simulated, rtol=1e-12)
"""


def apply_diff(name: str, text: str, change: str) -> str:
    """Return a file's text after applying a diff block without line numbers."""
    lines = [line for line in change.splitlines(keepends=True) if line.strip()]
    before = "".join(line[1:] for line in lines if line[0] in " -")
    after = "".join(line[1:] for line in lines if line[0] in " +")
    assert text.count(before) == 1, (
        f"the example for {name} in CONTRIBUTING.md no longer applies; expected exactly once in "
        f"that file:\n{before}"
    )
    return text.replace(before, after)


@pytest.fixture(scope="module")
def run_extended(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., str]:
    """Return a function that runs Python with a copy of levid that includes every example."""
    folder = tmp_path_factory.mktemp("contributing")
    files = subprocess.run(
        # New files that are not yet committed included.
        ["git", "ls-files", "-z", "-co", "--exclude-standard",
         "*.py", "config", "report", "drivers"],
        cwd=ROOT, capture_output=True, check=True, text=True,
    ).stdout  # fmt: skip
    for name in filter(None, files.split("\0")):
        if not name.startswith(("tests/", "benchmarks/")) and (ROOT / name).exists():
            (folder / "levid" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / "levid" / name)
    for kind, name, text in BLOCK.findall((ROOT / "CONTRIBUTING.md").read_text()):
        path = folder / "levid" / name
        assert path.exists() == (kind == "diff"), name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(apply_diff(name, path.read_text(), text) if kind == "diff" else text)

    def run(*arguments: object) -> str:
        paths = (folder, ROOT / "tests")
        ended = subprocess.run(
            [sys.executable, *map(str, arguments)],
            cwd=folder, capture_output=True, text=True, check=False,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))},
        )  # fmt: skip
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    return run


def test_candidate_and_simulated_effect_have_the_same_force(run_extended) -> None:
    run_extended("-c", TRAJECTORY)


def test_field_figure_verb_and_effect_appear_after_a_flight(run_extended, tmp_path: Path) -> None:
    (tmp_path / "lift.yaml").write_text(SESSION)
    effect = '{use: "levid.sim.effects.quintic:QuinticRods", dof: z, k5_n_m5: 1.0e+16}'
    nominal = (ROOT / "config" / "sims" / "nominal.yaml").read_text()
    (tmp_path / "sim.yaml").write_text(nominal.replace("effects: []", f"effects: [{effect}]"))
    levid = ("-m", "levid.cli.main")
    rig = ROOT / "config" / "rigs" / "loopback.yaml"
    flown = tmp_path / "flown"
    run_extended(
        *levid, "excite", tmp_path / "lift.yaml", "--rig", rig, "--sim", tmp_path / "sim.yaml",
        "--virtual", "--out", flown,
    )  # fmt: skip
    (log,) = flown.glob("*rest*.mcap")
    rows = read_log(log).rows  # the unmodified reader uses the log's schema
    # A sum of nine float32 values of some 8 N each.
    assert abs(rows["lift_n"] - rows["coil_n"].sum(axis=1)).max() < 1e-4
    assert "Lift force" in (flown / "report" / "index.html").read_text()
    assert f"{rows['lift_n'].mean():.3f} N" in run_extended(*levid, "lift", log)
    assert "lift" in run_extended(*levid, "--help")
