"""Each kind of difference between logs that log_rows_vs_commit finds, with both values."""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from levid.benchmarks.daemon import log_difference, log_rows_vs_commit

SCHEMA = "uint64 cycle  # [1] number\nfloat32[2] gap_m  # [m] height\nuint8 state"


def write(path: Path, rows: list[tuple[Any, ...]], **changes: Any) -> Path:
    """Write rows of cycle, two gaps and state by the mcap package, with some things changed."""
    path.parent.mkdir(exist_ok=True)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=changes.get("chunk_size", 1 << 20))
        writer.start("ros2")
        text = changes.get("schema", SCHEMA)
        schema = writer.register_schema("levid/msg/Cycle", "ros2msg", text.encode())
        channel = writer.register_channel("/levid/cycle", "cdr", schema)
        content = changes.get("content", b"")
        writer.add_attachment(0, 0, changes.get("attachment", "rig.yaml"), "text/plain", content)
        writer.add_metadata("levid", {"kind": changes.get("kind", "record")})
        for number, row in enumerate(rows):
            time = 1000 * number + changes.get("later", 0)
            writer.add_message(
                channel,
                time,
                b"\0\1\0\0" + struct.pack(changes.get("layout", "<QffB"), *row),
                time,
                number,
            )
        writer.finish()
    return path


ROWS = [(k, 1e-4 * k, -0.0, 3) for k in range(100)]


def changed(row: int, column: int, value: float) -> list[tuple[Any, ...]]:
    rows = [list(one) for one in ROWS]
    rows[row][column] = value
    return [tuple(one) for one in rows]


@pytest.mark.parametrize(
    "same",
    [
        {},
        {"chunk_size": 100},
        {"content": b"another rig"},
        {"schema": SCHEMA.replace("height", "height above the working point")},
    ],
)
def test_equal_rows_are_equal_however_they_are_packed(tmp_path: Path, same: dict) -> None:
    before, after = write(tmp_path / "a.mcap", ROWS), write(tmp_path / "b.mcap", ROWS, **same)
    assert log_difference.compare_logs(before, after) == (log_difference.Comparison(100))


@pytest.mark.parametrize(
    ("rows", "changes", "equal", "difference"),
    [
        (changed(60, 1, 0.5), {}, 60, "row 60: gap_m[0]: 0.006 before, 0.5 after"),
        (changed(99, 2, 0.0), {}, 99, "row 99: gap_m[1]: -0.0 before, 0.0 after"),
        (changed(0, 3, 4), {}, 0, "row 0: state: 3 before, 4 after"),
        (ROWS[:70], {}, 70, "row 70: the log goes on before, not after"),
        ([*ROWS, ROWS[0]], {}, 100, "row 100: the log ends before, not after"),
        (ROWS, {"later": 5}, 0, "row 0: log_time: 0 before, 5 after"),
        (
            ROWS,
            {"schema": SCHEMA.replace("uint8", "int8")},
            0,
            "field 2 of channel 1: uint8 state before, int8 state after",
        ),
        (
            ROWS,
            {"schema": SCHEMA + "\nuint8 stale"},
            0,
            "field 3 of channel 1: nothing before, uint8 stale after",
        ),
        (
            ROWS,
            {"attachment": "host.json"},
            0,
            "attachment 0: rig.yaml before, host.json after",
        ),
        (ROWS, {"kind": "move"}, 0, "metadata levid, kind: record before, move after"),
    ],
)
def test_first_difference_is_named_with_both_values(
    tmp_path: Path, rows: list, changes: dict, equal: int, difference: str
) -> None:
    before = write(tmp_path / "a.mcap", ROWS, chunk_size=100)
    found = log_difference.compare_logs(before, write(tmp_path / "b.mcap", rows, **changes))
    assert (found.rows, found.difference) == (equal, difference)


def test_field_that_one_version_lacks_is_ignored_on_request(tmp_path: Path) -> None:
    before = write(tmp_path / "a.mcap", ROWS)
    schema = SCHEMA.replace("uint8", "float32 lift_n\nuint8")
    for column, expected in ((1, "row 7: gap_m[0]: 0.0007 before, 9.0 after"), (None, "")):
        rows = ROWS if column is None else changed(7, column, 9.0)
        wider = [(*row[:3], 80.0, row[3]) for row in rows]
        after = write(tmp_path / "b.mcap", wider, schema=schema, layout="<QfffB")
        assert "lift_n" in log_difference.compare_logs(before, after).difference
        assert log_difference.compare_logs(before, after, {"lift_n"}).difference == expected


def test_logs_of_a_folder_are_compared_up_to_the_first_difference(tmp_path: Path) -> None:
    compare_folders = log_difference.compare_folders
    before, after = tmp_path / "before", tmp_path / "after"
    write(before / "00.mcap", ROWS), write(after / "00.mcap", ROWS)
    write(before / "01.mcap", ROWS)
    found = compare_folders(before, after)
    assert (found.rows, found.difference) == (100, "log: 01.mcap before, none after")
    write(after / "01.mcap", changed(5, 0, 6))
    found = compare_folders(before, after)
    assert (found.rows, found.difference) == (105, "01.mcap: row 5: cycle: 5 before, 6 after")


def test_log_that_was_cut_off_is_a_difference(tmp_path: Path) -> None:
    before, after = write(tmp_path / "a.mcap", ROWS), write(tmp_path / "b.mcap", ROWS)
    after.write_bytes(after.read_bytes()[:600])
    found = log_difference.compare_logs(before, after)
    assert found.difference


def test_session_flown_to_compare_ends_with_its_landing() -> None:
    head = "levid: session\nsteps:\n  - levitate: {}\n  - land: {}\n"
    for then in ("then: [identify]\n", "then:\n  - identify\n  - trace\n", "then: [a,\n  b]\n"):
        assert log_rows_vs_commit.without_then(head + then + "seed: 1\n") == head + "seed: 1\n"
    assert log_rows_vs_commit.without_then(head) == head


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["no-such-commit"], "git archive --format=tar no-such-commit"),
        (["HEAD", "--session", "beam", "moon"], "HEAD ships no session moon; it has beam, "),
    ],
)
def test_wrong_commit_or_session_is_named(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], said: str
) -> None:
    monkeypatch.setattr(sys, "argv", ["log_rows_vs_commit.py", *arguments])
    monkeypatch.setattr("signal.signal", lambda *_: None)
    with pytest.raises(SystemExit, match=said):
        log_rows_vs_commit.main()
