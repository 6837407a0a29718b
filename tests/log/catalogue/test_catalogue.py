"""Test `levid list`: flights with their notes and results, updated incrementally, as tables."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from levid.log.catalogue import catalogue
from levid.log.catalogue.catalogue import CATALOGUE, update_catalogue
from levid.log.log_summary import summarise_log

SESSION = """
levid: session
name: hop
steps:
  - levitate: {settle_s: 0.3}
  - record: {name: still, duration_s: 1, fade_s: 0.1}
  - land: {}
"""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, run_levid: Callable[..., int]) -> Path:
    """A flight with a note."""
    folder = tmp_path_factory.mktemp("catalogue")
    (folder / "hop.yaml").write_text(SESSION)
    arguments = ("--virtual", "--out", folder / "hop", "--note", "new rods, 21 °C")
    assert run_levid("excite", folder / "hop.yaml", *arguments) == 0
    return folder / "hop"


@pytest.fixture
def out(flown: Path, tmp_path: Path) -> Path:
    """A folder with two flights, one of which was cut off, and results of both."""
    root = tmp_path / "out"
    shutil.copytree(flown, root / "first")
    shutil.copytree(flown, root / "old" / "second")
    cut = root / "old" / "second" / "01-still.mcap"
    cut.write_bytes(cut.read_bytes()[:-3000])
    (root / "old" / "second" / "02-land.mcap").write_text("no log")
    for path in (root / "old").rglob("*.mcap"):
        os.utime(path, (1.7e9, 1.7e9))
    inside, elsewhere = root / "first" / "trace", root / "identified"
    inside.mkdir()
    elsewhere.mkdir()
    traced = {
        "command": "trace",
        "validation": {"before": 9.0, "after": 1.1, "noise_floor": 1.0},
        "answer": "Coil 6 gives 2 % less force than commanded.",
        "logs": [],
    }
    (inside / "result.json").write_text(json.dumps(traced))
    identified = {
        "command": "identify",
        "logs": [str((root / "old/second/01-still.mcap").resolve())],
        "points": [{"order": 9, "beam_m": 0.0}],
    }
    (elsewhere / "result.json").write_text(json.dumps(identified))
    return root


def test_the_newest_flight_comes_first_with_its_note_and_results(
    out: Path, levid: Callable[..., Any]
) -> None:
    code, text, _ = levid("list", out)
    assert code == 0
    lines = text.splitlines()
    assert lines[1].split()[2:5] == ["first", "loopback", "hop"]
    assert lines[2].strip() == "note: new rods, 21 °C"
    assert "less force than commanded. (error 9 times the noise before, 1.1 after)" in lines[3]
    assert "old/second" in lines[5]
    assert lines[5].endswith("1 incomplete, 1 unreadable, virtual")
    assert any("identify: order 9 at 1 beam position" in line for line in lines)
    first, second = map(json.loads, levid("list", out, "--json").out.splitlines())
    assert first["note"] == "new rods, 21 °C"
    assert (first["records"], first["logs"], first["rate_hz"]) == (1, 3, 1000)
    rows = [summarise_log(path) for path in sorted((out / "first").glob("*.mcap"))]
    assert first["rows"] == sum(log.rows for log in rows)
    assert first["length_s"] == pytest.approx(sum(log.length_s for log in rows))
    assert second["flown"].startswith("2023-11-14T22:13:20")
    assert [r["path"] for r in second["results"]] == ["identified"]


def test_filters(out: Path, levid: Callable[..., Any]) -> None:
    def folders(*arguments: str) -> list[str]:
        lines = levid("list", out, "--json", *arguments).out.splitlines()
        return [json.loads(line)["folder"] for line in lines]

    assert folders("--rig", "loopback", "--session", "hop") == ["first", "old/second"]
    assert folders("--since", "2024-01-01") == ["first"]
    assert folders("--rig", "magnet") == []


def test_only_changed_flights_are_read_again(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    whole = catalogue.summarise_run

    def counted(name: str, logs: list[Path]) -> Any:
        read.append(name)
        return whole(name, logs)

    monkeypatch.setattr(catalogue, "summarise_run", counted)
    before = update_catalogue(out)
    assert sorted(read) == ["first", "old/second"]
    read.clear()
    assert update_catalogue(out) == before
    assert read == []
    os.utime(out / "first" / "00-levitate.mcap")
    update_catalogue(out)
    assert read == ["first"]
    shutil.rmtree(out / "first")
    assert [run.summary.folder for run in update_catalogue(out)] == ["old/second"]
    # A damaged catalogue is made again.
    (out / CATALOGUE).write_text("{no json\n")
    assert [run.summary.folder for run in update_catalogue(out)] == ["old/second"]


def test_other_engines_query_the_catalogue(out: Path, levid: Callable[..., Any]) -> None:
    duckdb = pytest.importorskip("duckdb")
    pytest.importorskip("pyarrow")
    assert levid("list", out, "--parquet").code == 0
    for source in (f"'{out}/catalogue.parquet'", f"read_json('{out}/{CATALOGUE}')"):
        found = duckdb.sql(
            f"select folder, rows, trace from {source} where trace is not null and virtual"
        ).fetchall()
        assert [row[0] for row in found] == ["first"]
    flown = duckdb.sql(f"select min(flown) < now() from '{out}/catalogue.parquet'").fetchall()
    assert flown == [(True,)]


def test_a_note_is_one_line(flown: Path, tmp_path: Path, levid: Callable[..., Any]) -> None:
    for note, text in (("a\nb", "one line of text"), ("x" * 1001, "at most 1000 characters")):
        arguments = ("--virtual", "--out", tmp_path / "x", "--note", note)
        code, _, err = levid("excite", flown.parent / "hop.yaml", *arguments)
        assert code == 1
        assert text in err


def test_a_folder_without_flights(tmp_path: Path, levid: Callable[..., Any]) -> None:
    assert levid("list", tmp_path).err.strip().endswith("no flights")
    assert list(tmp_path.iterdir()) == []
    assert levid("list", tmp_path / "none").code == 1
