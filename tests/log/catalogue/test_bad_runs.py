"""A run that cannot be read hides no other: in `levid list` and commands of several files."""

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from levid.log.catalogue.catalogue import CATALOGUE
from levid.log.importing.importer import import_file

_SIGNALS = """
levid: signals
rate_hz: 250
columns:
  - {column: 0, name: f_n, unit: N, role: input}
  - {column: 1, name: x_m, unit: m, role: output}
"""
_YEAR_60000 = 1_830_000_000_000


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("log")
    rng = np.random.default_rng(1)
    np.savetxt(folder / "a.csv", rng.standard_normal((300, 2)), delimiter=",", fmt="%.6g")
    (folder / "signals.yaml").write_text(_SIGNALS)
    import_file(folder / "a.csv", folder / "signals.yaml", folder / "a.mcap")
    return folder / "a.mcap"


def _dangling_link(run: Path, _: Path) -> None:
    (run / "a.mcap").symlink_to(run / "missing.mcap")


def _link_to_itself(run: Path, _: Path) -> None:
    (run / "a.mcap").symlink_to(run / "a.mcap")


def _late_date(run: Path, log: Path) -> None:
    shutil.copy(log, run / "a.mcap")
    os.utime(run / "a.mcap", (_YEAR_60000, _YEAR_60000))


def _early_date(run: Path, log: Path) -> None:
    shutil.copy(log, run / "a.mcap")
    os.utime(run / "a.mcap", (-2e9, -2e9))


def _pipe(run: Path, _: Path) -> None:
    os.mkfifo(run / "a.mcap")


def _result_that_is_a_pipe(run: Path, log: Path) -> None:
    shutil.copy(log, run / "a.mcap")
    os.mkfifo(run / "result.json")


def _deep_result(run: Path, log: Path) -> None:
    shutil.copy(log, run / "a.mcap")
    (run / "result.json").write_text('{"command": "trace", "x": ' + "[" * 10**5 + "]" * 10**5 + "}")


def _result_without_form(run: Path, log: Path) -> None:
    shutil.copy(log, run / "a.mcap")
    wrong = {"command": "identify", "points": [{"order": 1e400, "beam_m": []}], "logs": 3}
    (run / "result.json").write_text(json.dumps(wrong).replace("Infinity", "1e999"))


def _folder_in_a_circle(run: Path, log: Path) -> None:
    shutil.copy(log, run / "a.mcap")
    (run / "again").symlink_to(run.parent)


@pytest.mark.parametrize(
    "spoil",
    [
        _dangling_link,
        _link_to_itself,
        _late_date,
        _early_date,
        _pipe,
        _result_that_is_a_pipe,
        _deep_result,
        _result_without_form,
        _folder_in_a_circle,
    ],
)
def test_bad_run_is_listed_and_hides_no_other(
    spoil: Callable[[Path, Path], None], log: Path, tmp_path: Path, levid: Callable[..., Any]
) -> None:
    for name in ("before", "run", "zz"):
        (tmp_path / name).mkdir()
    for name in ("before", "zz"):
        shutil.copy(log, tmp_path / name / "a.mcap")
    spoil(tmp_path / "run", log)
    for _ in range(2):  # the second time from the catalogue
        found = levid("list", tmp_path)
        assert found.code == 0
        for name in ("before", "run", "zz"):
            assert sum(line.split()[2:3] == [name] for line in found.out.splitlines()) == 1
    assert levid("list", tmp_path, "--json", "--since", "2020-01-01").code == 0


@contextmanager
def _as_another_user() -> Iterator[None]:
    os.seteuid(65_534)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that every user may enter; those above tmp_path are closed to others."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


@pytest.mark.skipif(os.geteuid() != 0, reason="root reads everything, and only root can change")
def test_run_without_rights_is_named_and_hides_no_other(
    log: Path, open_folder: Path, levid: Callable[..., Any]
) -> None:
    for name in ("closed", "open", "unreadable"):
        (open_folder / name).mkdir()
        shutil.copy(log, open_folder / name / "a.mcap")
    (open_folder / "closed").chmod(0o700)
    (open_folder / "unreadable" / "a.mcap").chmod(0o600)
    for command in ("list", "info"):  # imports what the other user may not be able to read
        assert levid(command, open_folder / "open").code == 0
    with _as_another_user():
        found = levid("list", open_folder)
        info = levid(
            "info", open_folder / "closed", open_folder / "unreadable", open_folder / "open"
        )
    assert found.code == 0
    assert f"{open_folder / 'closed'}: not searched: Permission denied" in found.err
    listed = [line.split()[2] for line in found.out.splitlines() if line.startswith("2")]
    assert sorted(listed) == ["open", "unreadable"]
    assert info.code == 1
    assert info.err.count("Permission denied") == 2
    assert str(open_folder / "open") in info.out


@pytest.mark.parametrize(
    "key",
    ["folder", "flown", "rate_hz", "records", "length_s", "virtual", "fault", "note", "state"],
)
@pytest.mark.parametrize("value", [None, "yesterday", [], -1])
def test_catalogue_of_other_types_is_computed_again(
    key: str, value: object, log: Path, tmp_path: Path, levid: Callable[..., Any]
) -> None:
    (tmp_path / "run").mkdir()
    shutil.copy(log, tmp_path / "run" / "a.mcap")
    before = levid("list", tmp_path)
    catalogue = tmp_path / CATALOGUE
    line = json.loads(catalogue.read_text())
    catalogue.write_text(json.dumps({**line, key: value}) + "\n" + "[" * 10**5)
    after = levid("list", tmp_path)
    assert after.code == 0
    if value != -1 and (key, value) != ("note", "yesterday"):  # values that a run may have
        assert after.out == before.out


def test_info_and_export_name_the_bad_log_and_go_on(
    log: Path, tmp_path: Path, levid: Callable[..., Any]
) -> None:
    bad, good = tmp_path / "bad.mcap", tmp_path / "good.mcap"
    bad.write_text("no log")
    shutil.copy(log, good)
    info = levid("info", bad, tmp_path / "none.mcap", good)
    assert info.code == 1
    assert "good.mcap" in info.out
    assert str(bad) in info.err
    assert "none.mcap: cannot be read: No such file" in info.err
    plain = json.loads(levid("info", bad, good, "--json").out)
    assert [Path(log["path"]).name for log in plain["logs"]] == ["good.mcap"]
    assert [error["path"] for error in plain["errors"]] == [str(bad)]
    export = levid("export", bad, good, "--format", "csv", "-o", tmp_path / "out")
    assert export.code == 1
    assert str(bad) in export.err
    assert (tmp_path / "out" / "good.csv").exists()
    assert not (tmp_path / "out" / "bad.csv").exists()
    check = levid("check", bad, good)
    assert check.code == 1
    assert f"{good}: " in check.out
