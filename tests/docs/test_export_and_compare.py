"""Test docs/export-and-compare.md: its Python code runs on a short flight."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from repository_folders import DOCS

from levid.log.exporting.columns import _GROUPS, _ROLE_GROUPS

DOC = (DOCS / "export-and-compare.md").read_text()
EXPORT, QUERY, CLUSTER = re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)
SESSION = """
levid: session
name: short
rate_hz: 500
seed: 3
excitations: {psi: {input: psi, rms_n_m: 0.1}, z: {input: z, rms_n: 1.3}}
steps:
  - levitate: {settle_s: 1}
  - record: {name: both, duration_s: 8, excite: [psi, z]}
  - land: {}
"""


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory, run_levid: Callable[..., int]) -> Path:
    folder = tmp_path_factory.mktemp("docs")
    (folder / "short.yaml").write_text(SESSION)
    arguments = ("--virtual", "--out", folder / "out" / "first")
    assert run_levid("excite", folder / "short.yaml", *arguments) == 0
    assert run_levid("list", folder / "out") == 0
    return folder / "out"


def test_a_log_is_exported(out: Path, tmp_path: Path) -> None:
    exec(EXPORT, {"log": out / "first" / "01-both.mcap", "folder": tmp_path})
    table = np.load(tmp_path / "pose.npz")
    assert table["time_s"][0] == 5.0
    assert "psi_rad" in table


def test_duckdb_queries_the_catalogue(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("duckdb")
    exec(QUERY, {"out": out})
    assert capsys.readouterr().out.startswith("short: 1 flights, 0.00")


def test_flights_are_recomputed_on_a_cluster(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("distributed")
    local = CLUSTER.replace(
        '"tcp://scheduler:8786"', "processes=False, n_workers=1, dashboard_address=None"
    )
    exec(local, {"out": out})
    value = re.search(r"first: k_z = ([\d.]+) \+- ([\d.]+) N/m", capsys.readouterr().out)
    # The simulated plant's stiffness, within three standard errors.
    assert abs(float(value[1]) - 2600.0) < 3 / 1.96 * float(value[2])


def test_all_groups_are_listed() -> None:
    for group in (*_GROUPS, *_ROLE_GROUPS):
        assert f"`{group}`" in DOC
