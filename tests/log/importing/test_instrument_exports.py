"""Files as instruments export them are imported with the right rate, units and values."""

from __future__ import annotations

import numpy as np
import pytest

from levid.benchmarks.log.instrument_files import EXPORTS, RATE_HZ, motion
from levid.benchmarks.log.new_user_import import import_as_new_user
from levid.log.reader import read_log

MOTION = motion(rows=1600)


@pytest.mark.parametrize("name", EXPORTS)
def test_export_of_an_instrument_is_imported_as_it_was_measured(tmp_path, name):
    export = EXPORTS[name](MOTION)
    draft, imported = import_as_new_user(tmp_path, name, export)
    assert ("FILL_IN" in draft.text) == (export.tick_s is not None)
    assert imported.rate_hz == pytest.approx(RATE_HZ, rel=1e-9)
    assert imported.warnings == ()
    ((path, rows),) = imported.logs
    assert rows == len(MOTION.time_s)
    log = read_log(path)
    # The files have four to eight digits; a value that is missing is interpolated.
    np.testing.assert_allclose(log.field("f_n"), MOTION.force_n, rtol=0, atol=2e-4)
    np.testing.assert_allclose(log.field("x_m"), MOTION.position_m, rtol=0, atol=5e-6)


def test_draft_shows_range_unit_and_five_values_of_each_column(tmp_path):
    draft, _ = import_as_new_user(tmp_path, "a", EXPORTS["dewesoft"](MOTION))
    lines = [line for line in draft.text.splitlines() if "column:" in line]
    assert len(lines) == 3
    for line, unit in zip(lines, ("s", "N", "mm"), strict=True):
        shown = line.partition("values ")[2]
        assert f" {unit}, such as " in shown
        assert len(shown.partition("such as ")[2].split(",")) == 5
