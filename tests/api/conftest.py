"""Sessions of the tests of the Python API: a short flight, and an imported measurement."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import levid

SESSION = {
    "levid": "session",
    "name": "short",
    "rate_hz": 500,
    "seed": 3,
    "excitations": {
        "psi": {"input": "psi", "rms_n_m": 0.1},
        "theta": {"input": "theta", "rms_n_m": 0.1},
        "z": {"input": "z", "rms_n": 1.3},
    },
    "steps": [
        {"levitate": {"settle_s": 1}},
        {"record": {"name": "psi", "duration_s": 9, "excite": ["psi"]}},
        {"record": {"name": "theta", "duration_s": 9, "excite": ["theta"]}},
        {"record": {"name": "z", "duration_s": 9, "excite": ["z"]}},
        {"land": {}},
    ],
}
SIGNALS = """
levid: signals
rate_hz: 100
columns:
  - {column: force, name: u_n, unit: N, role: input}
  - {column: position, name: y_m, unit: m, role: output, noise_sd: 1.0e-6}
"""
MODEL = """
levid: model
name: cart
dof: [{name: y, unit: m}]
inputs: [{name: u, unit: N}]
parameters:
  m: {value: 1.5, unit: kg, min: 0.1, max: 10}
  d: {value: 1.0, unit: N s/m, min: 0, max: 50}
  k: {value: 10.0, unit: N/m, min: 0, max: 500}
M: [[m]]
D: [[d]]
K: [[k]]
"""


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the logs of a short flight at 500 Hz."""
    folder = tmp_path_factory.mktemp("flown") / "short"
    levid.fly(SESSION, out=folder)
    return folder


@pytest.fixture(scope="session")
def session(flown: Path) -> levid.Session:
    return levid.load(flown)


@pytest.fixture(scope="session")
def found(session: levid.Session) -> levid.Identification:
    return session.identify()


@pytest.fixture(scope="session")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with data.csv, signals.yaml and model.yaml of a mass on a spring."""
    folder = tmp_path_factory.mktemp("measured")
    rng = np.random.default_rng(1)
    rows, step_s, inner = 3000, 0.01, 20
    u = np.repeat(rng.standard_normal(rows // 10), 10)
    y, x, v = np.zeros(rows), 0.0, 0.0
    for k in range(rows):
        y[k] = x
        for _ in range(inner):
            # 2 kg, 3 N s/m, 50 N/m, and a cubic spring that the model lacks
            v += step_s / inner * (u[k] - 3.0 * v - 50.0 * x - 1e5 * x**3) / 2.0
            x += step_s / inner * v
    y += 1e-6 * rng.standard_normal(rows)
    np.savetxt(
        folder / "data.csv",
        np.stack([u, y], 1),
        delimiter=",",
        header="force,position",
        comments="",
    )
    (folder / "signals.yaml").write_text(SIGNALS)
    (folder / "model.yaml").write_text(MODEL)
    return folder


@pytest.fixture(scope="session")
def imported(measured: Path) -> levid.Session:
    return levid.load(
        measured / "data.csv", measured / "model.yaml", signals=measured / "signals.yaml"
    )
