"""Test the recovery of damaged logs: all rows of undamaged chunks come back, and no wrong one."""

from __future__ import annotations

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader

from levid.log.errors import LogError
from levid.log.mcap_scan import HEAD, RECORD_HEAD
from levid.log.reader import read_log
from levid.log.salvage import salvage
from levid.log.signals import cycle_dtype
from levid.log.writer import FIRST_CHUNK_ROWS, LogWriter

DTYPE = cycle_dtype(4, 3)
ATTACHMENTS = {"rig.yaml": b"levid: rig\n" * 40}
METADATA = {"kind": "record", "session": "noise"}


def some_rows(count, first=1000):
    rng = np.random.default_rng(7)
    rows = np.zeros(count, DTYPE)
    rows["cycle"] = first + np.arange(count)
    rows["time_s"] = 0.001 * rows["cycle"]
    rows["gap_m"] = rng.normal(0.0, 1e-5, (count, 3)).astype(np.float32)
    rows["coil_n"] = rng.normal(0.0, 1.0, (count, 4)).astype(np.float32)
    return rows


def write_log(path, rows, **options):
    options = {"metadata": METADATA, "attachments": ATTACHMENTS, **options}
    with LogWriter(path, rows.dtype, rate_hz=1000, chunk_s=0.1, **options) as log:
        log.write(rows, 10**18 + 1_000_000 * rows["cycle"])
    return path


@pytest.fixture(scope="module")
def rows():
    return some_rows(1200)


@pytest.fixture(scope="module")
def path(rows, tmp_path_factory):
    return write_log(tmp_path_factory.mktemp("log") / "a.mcap", rows)


def chunks_of(data):
    """Return the first byte, the end and the rows of each chunk of an undamaged log."""
    found, at = [], 8
    size = RECORD_HEAD.size + 22 + 4 + DTYPE.itemsize
    while at < len(data) - 8:
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        if opcode == Opcode.CHUNK:
            raw = int.from_bytes(data[at + 25 : at + 33], "little")
            found.append((at, at + RECORD_HEAD.size + length, raw // size))
        at += RECORD_HEAD.size + length
    return found


def damaged(tmp_path, data):
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    return path


def test_undamaged_log_needs_no_salvage(path, rows):
    found = salvage(path)
    assert found.whole
    assert found.rows.tobytes() == rows.tobytes()
    assert (found.metadata["session"], found.attachments) == ("noise", ATTACHMENTS)


def test_five_hundred_logs_damaged_at_random(path, rows, tmp_path):
    """Flips, cuts, lost heads and zeroed blocks, up to three at once.

    A chunk counts as damaged if one of its bytes changed, or lies behind the cut. Of a log that has
    lost head, copy and summary the description comes from another log of the session.
    """
    data = path.read_bytes()
    chunks = chunks_of(data)
    starts = np.cumsum([0, *(count for *_, count in chunks)])
    other = write_log(tmp_path / "other.mcap", some_rows(100, first=5000))
    rng = np.random.default_rng(36)
    kinds = {"flip": 0, "cut": 0, "head": 0, "zero": 0}
    for _ in range(500):
        broken = bytearray(data)
        for _ in range(rng.integers(1, 4)):
            kind = rng.choice(list(kinds))
            kinds[kind] += 1
            at = int(rng.integers(8, len(broken)))
            if kind == "flip":
                broken[at] ^= 1 << int(rng.integers(8))
            elif kind == "cut":
                # Of a third at most: else three cuts would leave nothing to look at.
                del broken[max(at, 2 * len(broken) // 3) :]
            elif kind == "head":
                broken[: min(int(rng.integers(8, 2 * chunks[0][0])), len(broken))] = bytes(
                    min(int(rng.integers(8, 2 * chunks[0][0])), len(broken))
                )
            else:
                block = bytes(min(512, len(broken) - at))
                broken[at : at + len(block)] = block
        whole = [
            i
            for i, (begin, end, _) in enumerate(chunks)
            if len(broken) >= end and broken[begin:end] == data[begin:end]
        ]
        log = damaged(tmp_path, bytes(broken))
        if not whole:
            continue
        found = salvage(log, other)
        expected = np.concatenate([rows[starts[i] : starts[i + 1]] for i in whole])
        # What it returns beyond is right as well: damage of a chunk's record, not of its rows.
        assert np.isin(expected["cycle"], found.rows["cycle"]).all()
        assert np.all(np.diff(found.rows["cycle"].astype(np.int64)) > 0)
        assert found.rows.tobytes() == rows[found.rows["cycle"] - 1000].tobytes()
        np.testing.assert_array_equal(
            found.log_time_ns, 10**18 + 1_000_000 * found.rows["cycle"].astype(np.uint64)
        )
        if len(found.rows) < len(rows):
            assert not found.whole
    assert min(kinds.values()) > 100


def test_rows_behind_a_damaged_chunk_are_written_to_a_new_log(path, rows, tmp_path):
    data = bytearray(path.read_bytes())
    begin, end, count = chunks_of(data)[4]
    data[(begin + end) // 2] ^= 0xFF
    log = damaged(tmp_path, bytes(data))
    assert len(read_log(log).rows) < len(rows) / 3
    found = salvage(log)
    (lost,) = found.lost
    first = lost.before_row
    assert (lost.rows, found.described_by) == (count, "its head")
    assert lost.begin <= begin < end <= lost.end
    (new,) = found.write(tmp_path / "new.mcap")
    again = read_log(new)
    assert again.complete
    kept = np.delete(rows, np.arange(first, first + count))
    assert again.rows.tobytes() == kept.tobytes()
    assert again.metadata["session"] == "noise"
    assert "salvaged" in again.metadata
    assert again.attachments == ATTACHMENTS
    with pytest.raises(LogError, match="exists"):
        found.write(tmp_path / "new.mcap")


def test_any_wrong_bit_in_the_head_loses_no_row(path, rows, tmp_path):
    data = path.read_bytes()
    end = chunks_of(data)[0][0]
    checksum = data.rindex(HEAD.encode(), 0, end) - 13  # behind code, length, length of the name
    for at in range(8, end, 7):
        broken = bytearray(data)
        broken[at] ^= 0x10
        found = salvage(damaged(tmp_path, bytes(broken)))
        assert found.rows.tobytes() == rows.tobytes()
        # By a wrong code or length of the record with its checksum, the head is as it was.
        sources = ("its head", "the copy of its head behind the rows")
        assert found.described_by in sources[not checksum <= at < checksum + 9 :]
        assert (found.metadata["session"], found.attachments) == ("noise", ATTACHMENTS)
        assert not found.whole


def test_log_without_a_copy_of_its_head_is_described_by_its_summary(path, rows, tmp_path):
    """As of versions that wrote none: what the session was is lost with the head."""
    data = bytearray(path.read_bytes())
    data[8:100] = bytes(92)
    copy = data.index(HEAD.encode(), chunks_of(path.read_bytes())[-1][1])
    data[copy + 60] ^= 1
    found = salvage(damaged(tmp_path, bytes(data)))
    assert found.rows.tobytes() == rows.tobytes()
    assert found.described_by == "its summary, without attachments and metadata"
    assert (found.metadata, found.attachments) == ({}, {})
    assert found.rate_hz == 1000.0


def test_log_without_any_description_asks_for_another_log(path, rows, tmp_path):
    data = path.read_bytes()
    log = damaged(tmp_path, bytes(100) + data[100 : chunks_of(data)[-1][0]])
    with pytest.raises(LogError, match=r"damaged\.mcap: .*nothing describes the rows.*--like"):
        salvage(log)
    assert salvage(log, path).rows.tobytes() == rows[: len(salvage(log, path).rows)].tobytes()
    other = write_log(tmp_path / "b.mcap", some_rows(50)[["cycle", "time_s"]].astype(
        [("time_s", "<f8"), ("cycle", "<u8")]
    ))  # fmt: skip
    with pytest.raises(LogError, match="expected messages of"):
        salvage(log, other)
    # A description of the right size, with other fields.
    names = list(DTYPE.names)
    names[0], names[1] = names[1], names[0]
    swapped = np.zeros(50, [(name, DTYPE[name]) for name in names])
    swapped["time_s"] = np.arange(50)
    with LogWriter(
        tmp_path / "c.mcap", swapped.dtype, rate_hz=1000, metadata={}, attachments={}
    ) as writer:
        writer.write(swapped, np.arange(50, dtype=np.uint64))
    with pytest.raises(LogError, match="does not fit them"):
        salvage(log, tmp_path / "c.mcap")


@pytest.mark.parametrize("data", [b"", b"\x89MCAP0\r\n", bytes(5000), b"a,b\n1,2\n" * 100])
def test_file_without_a_chunk_is_an_error(tmp_path, data):
    with pytest.raises(LogError, match="found no undamaged chunk"):
        salvage(damaged(tmp_path, data))


def test_imported_log_is_written_in_parts(rows, tmp_path):
    """Its rows have no state: identification would join them across the gap."""
    attachments = {"signals.yaml": b"levid: signals\n"}
    path = write_log(tmp_path / "a.mcap", rows, attachments=attachments)
    data = bytearray(path.read_bytes())
    begin, end, _ = chunks_of(data)[5]
    data[(begin + end) // 2] ^= 1
    written = salvage(damaged(tmp_path, bytes(data))).write(tmp_path / "new.mcap")
    assert [p.name for p in written] == ["new-1.mcap", "new-2.mcap"]
    for part in written:
        assert np.all(np.diff(read_log(part).rows["cycle"].astype(int)) == 1)


def test_log_cut_anywhere_keeps_half_of_its_rows(path, rows, tmp_path):
    data = path.read_bytes()
    chunks = chunks_of(data)
    assert [count for *_, count in chunks][:4] == [32, 32, 64, 100]
    for begin, end, _ in chunks[1:]:
        readable = read_log(damaged(tmp_path, data[: end - 1])).rows
        whole = sum(count for first, _, count in chunks if first < begin)
        assert readable.tobytes() == rows[:whole].tobytes()
        assert len(readable) >= FIRST_CHUNK_ROWS


def test_other_tools_read_the_log_with_the_copy_of_its_head(path, rows):
    with path.open("rb") as file:
        reader = make_reader(file)
        names = [attachment.name for attachment in reader.iter_attachments()]
        assert sum(1 for _ in reader.iter_messages()) == len(rows)
    assert names == ["rig.yaml", HEAD]


def test_another_log_of_the_session_lends_no_name(path, rows, tmp_path):
    """A file's name tells its step: the description of another one would make it a take-off."""
    lift_off = {"kind": "levitate", "name": "levitate", "step": "0", "session": "noise"}
    other = write_log(tmp_path / "00-levitate.mcap", some_rows(60), metadata=lift_off)
    data = path.read_bytes()
    for name, kind in (("03-left-psi.mcap", "record"), ("04-move.mcap", "move")):
        log = tmp_path / name
        log.write_bytes(bytes(100) + data[100 : chunks_of(data)[-1][0]])
        found = salvage(log, other).metadata
        assert (found["kind"], found["session"]) == (kind, "noise")
        assert f"{int(found['step']):02d}-{found['name']}.mcap" == name


def test_rows_that_stand_in_a_file_twice_come_back_once(path, rows, tmp_path):
    data = path.read_bytes()
    for twice in (data + data, data[: len(data) // 2] + data[len(data) // 4 :]):
        found = salvage(damaged(tmp_path, twice))
        cycle = found.rows["cycle"].astype(int)
        assert np.all(np.diff(cycle) > 0)
        assert found.rows.tobytes() == rows[cycle - 1000].tobytes()


def test_errors_name_the_file(tmp_path):
    with pytest.raises(LogError, match=r"nope\.mcap: cannot be read"):
        salvage(tmp_path / "nope.mcap")
    with pytest.raises(LogError, match="found a folder"):
        salvage(tmp_path)
