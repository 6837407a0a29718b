"""Measured data: the Silverbox (Wigren and Schoukens), an electronic Duffing oscillator."""

from __future__ import annotations

from pathlib import Path

import yaml

from levid.config.base import read_mapping
from levid.config.shipped import shipped
from levid.log.importing.importer import import_file

SOURCE = Path(__file__).resolve().parents[3] / "shared" / "data" / "silverbox" / "SNLS80mV.csv"
MODEL = shipped("models/silverbox.yaml")
SIGNALS = shipped("signals/silverbox.yaml")
TRAIN, TEST = (40_650, 105_711), (105_712, 127_399)
"""First and last rows of the usual parts: odd multisines, ten realisations, and one more."""
FIRST_ROWS = 50
"""Of a part serve to start a model."""


def imported(rows: tuple[int, int], folder: Path) -> Path:
    """Return the log of these rows, first and last, written into `folder`."""
    signals = folder / f"signals-{rows[0]}.yaml"
    plain = read_mapping(SIGNALS) | {"rows": {"first": rows[0], "last": rows[1]}}
    signals.write_text(yaml.safe_dump(plain))
    log = folder / f"from-{rows[0]}.mcap"
    import_file(SOURCE, signals, log)
    return log
