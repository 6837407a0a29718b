"""What results are written to, and commands that a shell takes as they are."""

from __future__ import annotations

import os
import shlex
import time
from pathlib import Path

import pytest

from levid.cli.result_folders import logs_in, older_results, quoted, same_logs, writable_folder
from levid.config.base import ConfigError


def test_a_folder_that_cannot_be_written_is_found_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writable_folder(tmp_path / "new" / "deeper")
    assert not (tmp_path / "new").exists()  # a work that fails leaves nothing
    (tmp_path / "report.html").write_text("")
    for out in ("report.html", "report.html/x"):
        with pytest.raises(ConfigError, match=r"report.html.*: expected a folder, found .*file"):
            writable_folder(tmp_path / out)
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    with pytest.raises(ConfigError, match="may not be written to"):
        writable_folder(tmp_path / "new")


def test_commands_take_any_name() -> None:
    odd = Path("my runs") / "it's"
    assert shlex.split(quoted(odd, Path("x"))) == [str(odd), "x"]
    assert shlex.split(logs_in(odd)) == [f"{odd}/*.mcap"]
    assert logs_in(odd).endswith("/*.mcap")  # which the shell has to see
    few = [odd / "a.mcap", odd / "b.mcap"]
    assert shlex.split(same_logs(few)) == list(map(str, few))


def test_many_logs_are_named_by_folder_only_where_they_are_all_of_it(tmp_path: Path) -> None:
    paths = []
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        paths += [tmp_path / day / f"{k}.mcap" for k in range(3)]
    for path in paths:
        path.write_bytes(b"")
    monday, tuesday = (logs_in(tmp_path / day) for day in ("monday", "tuesday"))
    assert same_logs(paths) == f"{monday} {tuesday}"
    assert same_logs(paths[:5]) == f"{monday} {quoted(*paths[3:5])}"


def test_what_stands_where_results_go_is_found_before_the_work(tmp_path: Path) -> None:
    for name in ("model.yaml", "figures/x"):
        (tmp_path / "a" / name).mkdir(parents=True)
    writable_folder(tmp_path / "a", ("index.html",), ("figures",))
    with pytest.raises(ConfigError, match=r"to write model.yaml, found a folder of that name"):
        writable_folder(tmp_path / "a", ("model.yaml",))
    (tmp_path / "figures").write_text("")
    with pytest.raises(ConfigError, match="expected figures to be a folder"):
        writable_folder(tmp_path, (), ("figures",))
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    with pytest.raises(ConfigError, match="found a link to nothing"):
        writable_folder(tmp_path / "link")


def test_results_of_an_earlier_run_are_named(tmp_path: Path) -> None:
    (tmp_path / "model.yaml").write_text("")
    began_s = time.time() + 1.0
    (tmp_path / "identified.mat").write_text("")
    os.utime(tmp_path / "identified.mat", (began_s + 1.0,) * 2)
    names = ("model.yaml", "identified.mat", "multisine.mat")
    assert older_results(tmp_path, names, began_s) == [tmp_path / "model.yaml"]
