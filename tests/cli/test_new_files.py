"""Test `levid new`: copies of shipped files that work in every folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from levid.config.shipped import KINDS, shipped_names

EVERY = [(kind, name) for kind in KINDS for name in shipped_names(kind)]


@pytest.mark.parametrize(("kind", "name"), EVERY)
def test_every_copy_passes_check_in_another_folder(
    levid, kind: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert levid("new", kind, name, "-o", "my-own.yaml").code == 0
    outcome = levid("check", "my-own.yaml")
    assert outcome.code == 0, outcome.err
    text = Path("my-own.yaml").read_text()
    assert "../" not in text
    if "\nname: " in text:
        assert "\nname: my-own" in text


def test_a_copy_overwrites_nothing(levid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("beam.yaml").write_text("mine")
    outcome = levid("new", "session", "beam")
    assert outcome.code == 1
    assert "beam.yaml: exists" in outcome.err
    assert Path("beam.yaml").read_text() == "mine"


@pytest.mark.parametrize(
    ("kind", "name", "words"),
    [
        ("rig", "lopback", "Did you mean loopback?"),
        ("rig", "triangle", "levid new rig loopback -o FILE.yaml"),
        ("session", "zzz", "levid ships the sessions beam, gains"),
    ],
)
def test_an_unknown_name_says_what_there_is(levid, kind: str, name: str, words: str) -> None:
    outcome = levid("new", kind, name)
    assert outcome.code == 2
    assert words in " ".join(outcome.err.split())
