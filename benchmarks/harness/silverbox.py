"""Measured data: the Silverbox (Wigren and Schoukens), an electronic Duffing oscillator."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from levid.config.base import read_mapping
from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.trace.linearised.linearisation_point import WorkingPoint
from levid.identification.trace.records.record_from_log import trace_record
from levid.identification.trace.residual.free_run_with_effects import free_run
from levid.log.importing.importer import import_file
from levid.log.reader import read_log
from levid.model.effects.base import Effect, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

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


def laws_of_motion(places: Places, extent: Extent) -> list[Effect]:
    """Return the laws of position and speed: with all others a trace takes twice as long."""
    classes = {"stiffness", "damping", "friction", "inertia"}
    return [e for e in all_effects(places, extent) if e.effect_class in classes]


def free_run_error(point: WorkingPoint, log: Path) -> float:
    """Return the RMS error in V of a free run of a log; nan if it does not converge."""
    record = trace_record(read_log(log), load_model(MODEL))
    run = free_run(point, record)
    error = (record.gap - run.gap)[run.counts_from :]
    return float(np.sqrt(np.mean(error**2))) if run.settled else float("nan")
