"""The examples of docs/log-format.md run, one after the other, as they stand."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import yaml

from levid.log.reader import read_log
from levid.log.signals_file import SignalsFile

TEXT = (Path(__file__).parents[1] / "docs" / "log-format.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def test_the_stranger_s_log_is_written_and_read_as_the_docs_say(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scripts = blocks("python")
    assert len(scripts) == 3
    for script in scripts:
        exec(compile(script, "log-format.md", "exec"), {})
    log = read_log("drive.mcap")
    assert log.complete
    assert log.rate_hz == 1000.0
    np.testing.assert_array_equal(log.field("time_s"), np.arange(2000) / 1000)
    np.testing.assert_array_equal(log.field("u_n")[:100], [1.0] * 50 + [-1.0] * 50)


def test_the_example_of_a_signals_file_is_one():
    (example,) = blocks("yaml")
    assert SignalsFile.model_validate(yaml.safe_load(example)).rate_hz == 610.35
