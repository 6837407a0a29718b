"""A mass on a spring: its declared model, and simulated records imported as logs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.log.importing.importer import import_file

MASS = parse_text(
    """
levid: model
name: mass
dof: [{name: x_m, unit: m}]
inputs: [{name: f_n, unit: N}]
input: band_limited
parameters:
  m: {value: 2.0, unit: kg, min: 0.1, max: 20}
M: [[m]]
D: [[12.0]]
K: [[800.0]]
""",
    ModelConfig,
    "mass",
)

SIGNALS = """
levid: signals
rate_hz: 250
input_hold: band_limited
columns:
  - {column: 0, name: f_n, unit: N, role: input}
  - {column: 1, name: x_m, unit: m, role: output}
"""


AT_50_HZ = """
levid: signals
rate_hz: 50
columns:
  - {column: 0, name: f_n, unit: N, role: input}
  - {column: 1, name: x_m, unit: m, role: output}
"""


def imported(folder: Path, name: str, table: np.ndarray, columns: str = SIGNALS) -> Path:
    """Return the log of a record `name`, whose force in N and position in m are `table` (N, 2).

    `columns` is the text of the signals.yaml.
    """
    data, signals, log = folder / f"{name}.csv", folder / "signals.yaml", folder / f"{name}.mcap"
    np.savetxt(data, table, delimiter=",", fmt="%.17g")
    signals.write_text(columns)
    import_file(data, signals, log)
    return log


def moved(rows: int, seed: int = 1) -> np.ndarray:
    """Return forces and positions (rows, 2) of a mass of 1.8 kg on the spring and damper of MASS.

    The force is random below 25 Hz and has the record as its period, so the motion is exact.
    """
    rng = np.random.default_rng(seed)
    freq_hz = np.fft.rfftfreq(rows, 1 / 250.0)
    force = np.fft.rfft(rng.normal(size=rows)) * (freq_hz < 25.0)
    s = 2j * np.pi * freq_hz
    position = np.fft.irfft(force / (1.8 * s * s + 12.0 * s + 800.0), rows)
    noise = 1e-3 * position.std() * rng.normal(size=rows)
    return np.column_stack((np.fft.irfft(force, rows), position + noise))
