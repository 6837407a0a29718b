"""Test that shipped files are known by name, in every key that names a file, and beside paths."""

from __future__ import annotations

from pathlib import Path

import pytest

from levid.config.base import ConfigError
from levid.config.model import load_model
from levid.config.rig import load_rig, model_path
from levid.config.session import load_session
from levid.config.shipped import KINDS, find_file, shipped, shipped_file, shipped_names

RIG = shipped("rigs/loopback.yaml").read_text()


@pytest.mark.parametrize("kind", KINDS)
def test_every_shipped_file_is_found_by_its_name(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert shipped_names(kind)
    for name in shipped_names(kind):
        assert find_file(name, kind).read_text().find(f"\nlevid: {kind}\n") >= 0
        assert find_file(Path(name), kind) == shipped_file(name, kind)


def test_a_file_wins_over_a_name_and_a_folder_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("beam").mkdir()  # such as the one of `--out beam`
    assert find_file("beam", "session") == shipped("sessions/beam.yaml")
    assert find_file("beam", "session", folders=True) == Path("beam")
    Path("beam").rmdir()
    Path("beam").write_text("mine")
    assert find_file("beam", "session") == Path("beam")


def test_a_name_of_two_kinds_is_told_apart_by_its_folder() -> None:
    assert shipped_file("rig") is None
    assert shipped_file("sims/rig") == shipped("sims/rig.yaml")
    assert shipped_file("rig", "model") == shipped("models/rig.yaml")


@pytest.mark.parametrize(
    ("load", "path", "words"),
    [
        (load_session, "bem", "similar names beam"),
        (load_session, "config/sessions/beam.yaml", "levid ships a session with the name beam"),
        (load_rig, "lopback", "similar names loopback"),
        (load_rig, "xyz", "levid ships the rigs can, canfd, loopback, serial"),
        (load_model, "../models/rig.yaml", "levid ships a model with the name rig"),
    ],
)
def test_an_unknown_name_lists_near_matches(
    load, path: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=words) as refused:
        load(find_file(path))
    assert path in str(refused.value)


def test_keys_of_a_rig_take_names_and_relative_paths(tmp_path: Path) -> None:
    text = RIG.replace("../models/rig.yaml", "rig").replace("../sims/nominal.yaml", "nominal")
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    assert load_rig(path).model == load_model(shipped("models/rig.yaml"))
    assert model_path(path) == shipped("models/rig.yaml")
    own = shipped("models/rig.yaml").read_text().replace("name: rig", "name: own")
    (tmp_path / "rig").write_text(own)  # beside the rig, whatever the current folder is
    model = load_rig(path).model
    assert model is not None
    assert not isinstance(model, str)
    assert model.name == "own"
