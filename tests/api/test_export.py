"""Test that records are exported with one call."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.io import loadmat

import levid

SESSION = {
    "levid": "session",
    "name": "short",
    "rate_hz": 500,
    "excitations": {"z": {"input": "z", "rms_n": 1.0}},
    "steps": [
        {"levitate": {"settle_s": 0.5}},
        {"record": {"name": "z", "duration_s": 2, "excite": ["z"]}},
        {"land": {}},
    ],
}


def test_records_are_exported_with_units(tmp_path) -> None:
    session = levid.fly(SESSION, note="a test")
    (path,) = session.export(tmp_path / "tables", "mat", ["z_m", "gap_m"])
    found = loadmat(path, squeeze_me=True)
    np.testing.assert_array_equal(found["z_m"], session["z"]["z_m"])
    assert found["gap_m"].shape == session["z"]["gap_m"].shape
    assert session["z"].export(tmp_path / "z.csv").exists()
    with pytest.raises(levid.LogError, match="exists"):
        session.export(tmp_path / "tables", "mat")


def test_a_text_is_one_column(tmp_path) -> None:
    record = levid.fly(SESSION)["z"]
    header = record.export(tmp_path / "z.csv", "z_m").read_text().partition("\n")[0]
    assert header == "time_s,z_m"


def test_files_of_records_with_equal_names_are_in_the_folder(tmp_path) -> None:
    for name in ("a", "b"):
        levid.fly(SESSION, out=tmp_path / name)
    session = levid.load([tmp_path / "a", tmp_path / "b"])
    assert session.names == ("a/z", "b/z")
    paths = session.export(tmp_path / "tables", "npz", "z_m")
    assert [path.name for path in paths] == ["a-z.npz", "b-z.npz"]
    assert all(path.parent == tmp_path / "tables" and path.is_file() for path in paths)
