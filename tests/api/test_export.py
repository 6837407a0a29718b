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
