"""Test docs/log-format.md: its examples run in order."""

from __future__ import annotations

import re
import warnings

import numpy as np
import yaml
from repository_folders import DOCS

from levid.identification.identify import identify
from levid.identification.records.from_log import from_log
from levid.log.importing.signals_yaml import SignalsFile
from levid.log.reader import read_log

TEXT = (DOCS / "log-format.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def test_foreign_log_of_the_docs_is_written_read_and_identified(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scripts = blocks("python")
    assert len(scripts) == 3
    for script in scripts:
        exec(compile(script, "log-format.md", "exec"), {})
    log = read_log("drive.mcap")
    assert log.complete
    assert log.rate_hz == 1000.0
    np.testing.assert_array_equal(log.field("time_s"), np.arange(2000) / 1000)
    u_n, z_m = log.field("u_n"), log.field("z_m")
    np.testing.assert_allclose(z_m[1:], 0.95 * z_m[:-1] + 0.05e-6 * u_n[:-1], rtol=0, atol=1e-18)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (point,) = identify([from_log(log)]).points
    assert point.order == 1
    (pole,) = np.linalg.eigvals(point.model.A)
    # The record has no noise; the error is the response beyond 200 taps, 0.95^200 = 4e-5.
    assert abs(pole - 0.95) < 1e-4


def test_example_of_a_signals_file_is_valid():
    plain, loop = map(yaml.safe_load, blocks("yaml"))
    assert SignalsFile.model_validate(plain).rate_hz == 610.35
    law = SignalsFile.model_validate({"levid": "signals", "rate_hz": 1000.0, **loop}).loop
    assert law is not None
    assert law.law is not None
    assert law.law.drives == ("u_v",)
