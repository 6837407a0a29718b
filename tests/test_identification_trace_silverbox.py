"""Measured data: the Silverbox, an electronic Duffing oscillator, traced from its linear model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.trace.free_run import free_run
from levid.identification.trace.record import trace_record
from levid.identification.trace.study import trace
from levid.identification.trace.workers import Alone
from levid.identification.trace.working_point import WorkingPoint
from levid.log.importer import import_file
from levid.log.reader import read_log
from levid.model.effects.table import all_effects

MEASURED = Path(__file__).parents[2] / "shared" / "data" / "silverbox" / "SNLS80mV.csv"
TRAIN = ((40_650, 48_841), (65_226, 73_417), (89_802, 97_993))
"""Rows of three eighths of the usual training part, to be quick."""
TEST = (105_712, 127_399)
CONFIG = load_model(shipped("models/silverbox.yaml"))

pytestmark = pytest.mark.skipif(
    not MEASURED.exists(), reason="the Silverbox's measurements are not beside this repository"
)


def imported(folder: Path, rows: tuple[int, int]) -> Path:
    text = shipped("signals/silverbox.yaml").read_text()
    signals, log = folder / "signals.yaml", folder / f"from-{rows[0]}.mcap"
    signals.write_text(text.replace("40650, last: 105711", f"{rows[0]}, last: {rows[1]}"))
    assert import_file(MEASURED, signals, log) == rows[1] - rows[0] + 1
    return log


def test_error(point: WorkingPoint, log: Path) -> float:
    """Return the rms error in V of a free run of the test part."""
    record = trace_record(read_log(log), CONFIG)
    run = free_run(point, record)
    assert run.settled
    error = record.gap[:, 0] - run.gap[:, 0]
    return float(np.sqrt(np.mean(error[run.counts_from :] ** 2)))


test_error.__test__ = False  # type: ignore[attr-defined]


def test_cube_and_square_are_named_and_the_error_falls_more_than_tenfold(tmp_path: Path) -> None:
    logs = [imported(tmp_path, rows) for rows in TRAIN]
    found = trace(logs, CONFIG, all_effects, Alone(CONFIG), lambda *_: None)
    named = [p.effect.key for p in found.found.point.placed]
    assert named[:2] == ["stiffness.cubic", "stiffness.asymmetric"]
    unseen = imported(tmp_path, TEST)
    before, after = (test_error(p, unseen) for p in (found.declared, found.found.point))
    # A linear model leaves 7 mV, a cubic one 0.65 mV, with the square that is there too 0.40 mV.
    assert before > 5e-3
    assert after < 0.40e-3
    alone = replace(
        found.found.point,
        placed=tuple(p for p in found.found.point.placed if p.effect.key == "stiffness.cubic"),
    )
    assert test_error(alone, unseen) < before / 3  # most of it is the cube's own work
