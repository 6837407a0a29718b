"""YAML files with changed text end in a configuration or in an error that names the file."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from levid.config.base import ConfigError
from levid.config.load_any_kind import load_any
from levid.config.shipped import shipped

FILES = (
    "rigs/loopback.yaml",
    "rigs/can.yaml",
    "sims/nominal.yaml",
    "sessions/beam.yaml",
    "sessions/white-noise-1khz.yaml",
    "models/rig.yaml",
)
PIECES = st.sampled_from(
    [
        *(
            "",
            "~",
            "[]",
            "{}",
            ": ",
            "- ",
            "&a",
            "*a",
            "!!int",
            "\t",
            "\n",
            "'",
            '"',
            "#",
            "? ",
            "|",
        ),
        *("1e400", "-1", "0x1", "nan", "yes", "<<: *a", "\x00", "\ufffe", "é", "[[[[", "1_0", "%"),
        "2026-11-26",
    ]
)


@given(
    name=st.sampled_from(FILES),
    edits=st.lists(
        st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 12), PIECES),
        min_size=1,
        max_size=4,
    ),
)
def test_changed_yaml_is_read_or_reported(name, edits, tmp_path_factory) -> None:
    text = shipped(name).read_text(encoding="utf-8")
    for share, cut, piece in edits:
        at = int(share * len(text))
        text = text[:at] + piece + text[at + cut :]
    path: Path = tmp_path_factory.getbasetemp() / "fuzzed.yaml"
    path.write_text(text, encoding="utf-8")
    with contextlib.suppress(ConfigError):
        load_any(path, {})


@given(st.text(max_size=200))
def test_any_text_is_reported(tmp_path_factory, text) -> None:
    path: Path = tmp_path_factory.getbasetemp() / "text.yaml"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    with pytest.raises(ConfigError, match=r"text\.yaml"):
        load_any(path, {})
