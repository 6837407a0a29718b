"""Test reading logs: of levid and of other writers, complete, truncated and damaged."""

from __future__ import annotations

import io
import os
import struct
import tracemalloc

import lz4.frame
import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from levid.log import mcap_scan, reader, writer
from levid.log.errors import LogError
from levid.log.mcap_scan import RECORD_HEAD, scan
from levid.log.reader import read_log
from levid.log.signals import cycle_dtype, dtype_from_ros2msg, ros2msg
from levid.log.writer import LogWriter

DTYPE = cycle_dtype(4, 3)
STEP_NS = 1_000_000


def some_rows(count, dtype=DTYPE):
    bits = np.random.default_rng(2).integers(0, 256, (count, dtype.itemsize), np.uint8)
    return bits.view(dtype)[:, 0]


def times_of(count):
    return 10**18 + STEP_NS * np.arange(count, dtype=np.uint64)


@pytest.fixture(scope="module")
def rows():
    return some_rows(400)


@pytest.fixture(scope="module")
def path(rows, tmp_path_factory):
    """Return a log with eight chunks of 50 rows, the first as large as the others."""
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "FIRST_CHUNK_ROWS", 50)
        return write(path, rows)


def write(path, rows):
    with LogWriter(
        path,
        DTYPE,
        rate_hz=100,
        chunk_s=0.5,
        metadata={"kind": "record"},
        attachments={"rig.yaml": b"levid: rig\n" * 20},
    ) as log:
        log.write(rows, times_of(rows.size))
    return path


def chunks_of(data):
    """Return the first byte and the end of each chunk record of an MCAP file."""
    chunks, at = [], 8
    while at < len(data) - 8:
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        end = at + RECORD_HEAD.size + length
        if opcode == Opcode.CHUNK:
            chunks.append((at, end))
        at = end
    return chunks


def read_bytes(tmp_path, data):
    path = tmp_path / "changed.mcap"
    path.write_bytes(data)
    return read_log(path)


def test_round_trip_preserves_every_bit(path, rows):
    log = read_log(path)
    assert log.rows.dtype == DTYPE
    assert log.rows.tobytes() == rows.tobytes()
    np.testing.assert_array_equal(log.log_time_ns, times_of(rows.size))
    assert (log.rate_hz, log.schema_name) == (100.0, "levid/msg/Cycle")
    assert log.metadata == {"format": "1", "kind": "record", "rate_hz": "100.0"}
    assert log.attachments == {"rig.yaml": b"levid: rig\n" * 20}
    assert log.complete
    assert log.problem is None


def test_misspelt_field_is_rejected_with_similar_names(path, rows):
    log = read_log(path)
    np.testing.assert_array_equal(log.field("gap_m"), rows["gap_m"])
    with pytest.raises(LogError, match="no field 'gap_mm'; there is gap_m"):
        log.field("gap_mm")


def test_truncated_log_gives_the_complete_chunks_before_the_cut(path, rows, tmp_path):
    data = path.read_bytes()
    ends = [end for _, end in chunks_of(data)]
    assert len(ends) == 8
    cuts = np.random.default_rng(3).integers(0, len(data), 200).tolist()
    edges = [edge + by for edge in (8, ends[0], ends[3], len(data) - 8) for by in (-1, 0, 1)]
    opened = 0
    for cut in [*cuts, *edges, len(data) - 1]:
        whole = 50 * sum(end <= cut for end in ends)
        if not whole:
            with pytest.raises(LogError, match=r"byte|empty"):
                read_bytes(tmp_path, data[:cut])
            continue
        log = read_bytes(tmp_path, data[:cut])
        assert not log.complete
        assert "byte" in log.problem
        assert log.rows.tobytes() == rows[:whole].tobytes(), cut
        assert log.attachments["rig.yaml"] == b"levid: rig\n" * 20
        opened += 1
    assert opened > 100


@pytest.mark.parametrize("seed", range(4))
def test_damaged_byte_gives_an_error_or_the_rows_before_it(path, rows, tmp_path, seed):
    # CRCs cover head, chunks and summary: a flipped bit must not give a wrong row or label.
    data = path.read_bytes()
    rng = np.random.default_rng(seed)
    for _ in range(100):
        damaged = bytearray(data)
        at = int(rng.integers(len(data)))
        damaged[at] ^= int(rng.integers(1, 256))
        try:
            log = read_bytes(tmp_path, bytes(damaged))
        except LogError as error:
            assert "byte" in str(error) or "expected" in str(error)  # noqa: PT017
            continue
        assert log.rows.size % 50 == 0
        assert log.rows.tobytes() == rows[: log.rows.size].tobytes(), at
        assert log.rows.size == rows.size or not log.complete
        assert (log.rate_hz, log.metadata["kind"]) == (100.0, "record")


def test_many_damaged_bytes_raise_log_errors_only(path, tmp_path):
    data = path.read_bytes()
    rng = np.random.default_rng(5)
    for _ in range(100):
        damaged = np.frombuffer(data, np.uint8).copy()
        places = rng.integers(0, damaged.size, 20)
        damaged[places] = rng.integers(0, 256, 20)
        try:
            read_bytes(tmp_path, damaged.tobytes())
        except LogError:
            continue


@pytest.mark.parametrize("length", [2**31, 2**40, 2**63, 2**64 - 1])
@pytest.mark.parametrize("which", [0, 5])
def test_corrupt_length_allocates_no_memory(path, rows, tmp_path, length, which):
    data = path.read_bytes()
    start, _ = chunks_of(data)[which]
    lengths = {
        "of the record": start + 1,
        "uncompressed": start + RECORD_HEAD.size + 16,
        "compressed": start + RECORD_HEAD.size + 28 + len(b"\4\0\0\0zstd"),
    }
    for what, at in lengths.items():
        damaged = data[:at] + struct.pack("<Q", length) + data[at + 8 :]
        tracemalloc.start()
        try:
            log = read_bytes(tmp_path, damaged)
        except LogError:
            assert which == 0, what
        else:
            assert log.rows.tobytes() == rows[: 50 * which].tobytes(), what
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        # The memory for the whole log; the smallest of these lengths is 40,000 times as large.
        assert peak < 10 * len(data), what


def test_log_larger_than_the_memory_is_rejected_before_decompression(path, rows, monkeypatch):
    """Its file may be small: zstd compresses zeros to almost nothing."""
    claimed = sum(c.uncompressed_size for c in scan(memoryview(path.read_bytes())).chunks.values())
    monkeypatch.setattr(reader, "memory_bytes", lambda: claimed)
    assert read_log(path).rows.tobytes() == rows.tobytes()
    monkeypatch.setattr(reader, "memory_bytes", lambda: claimed - 1)
    with pytest.raises(LogError, match=r"expected a log that this computer's memory of .* GiB"):
        read_log(path)
    monkeypatch.undo()
    assert reader.memory_bytes() > 2**28


@pytest.mark.parametrize("opcode", [Opcode.MESSAGE_INDEX, Opcode.SUMMARY_OFFSET, 0x86])
def test_rows_end_before_a_chunk_with_a_wrong_opcode(path, rows, tmp_path, opcode):
    data = path.read_bytes()
    start, _ = chunks_of(data)[2]
    log = read_bytes(tmp_path, data[:start] + bytes([opcode]) + data[start + 1 :])
    assert not log.complete
    assert log.rows.tobytes() == rows[:100].tobytes()


def test_rows_end_before_a_chunk_whose_length_includes_the_next(path, rows, tmp_path):
    data = path.read_bytes()
    (start, _), (_, end), (_, after) = chunks_of(data)[2:5]
    swallowed = data[: start + 1] + struct.pack("<Q", end - start - RECORD_HEAD.size)
    # Cut off before the index, which would detect the missing chunk.
    log = read_bytes(tmp_path, swallowed + data[start + RECORD_HEAD.size : after])
    assert not log.complete
    assert log.rows.tobytes() == rows[:100].tobytes()


def test_rows_end_before_a_message_shorter_than_its_header(rows, tmp_path):
    data = mcap_bytes(lambda w: write_rows(w, rows), use_chunking=False)
    size = RECORD_HEAD.size + 22 + 4 + DTYPE.itemsize
    at = data.index(rows[200].tobytes()) + DTYPE.itemsize - size
    log = read_bytes(tmp_path, data[: at + 1] + struct.pack("<Q", 13) + data[at + 9 :])
    assert not log.complete
    assert f"byte {at}: expected a message" in log.problem
    assert log.rows.tobytes() == rows[:200].tobytes()


def mcap_bytes(build, **options):
    """Return an MCAP file by the writer of the mcap package, filled by `build`."""
    file = io.BytesIO()
    writer = Writer(file, **options)
    writer.start("ros2")
    build(writer)
    writer.finish()
    return file.getvalue()


def write_rows(writer, rows, *, topic="/levid/cycle", text=None, head=b"\0\1\0\0", tail=b""):
    schema = writer.register_schema("x/msg/Y", "ros2msg", (text or ros2msg(rows.dtype)).encode())
    channel = writer.register_channel(topic, "cdr", schema)
    for number, row in enumerate(rows):
        time = int(times_of(number + 1)[-1])
        writer.add_message(channel, time, head + row.tobytes() + tail, time, number)
    return channel


@pytest.mark.parametrize("compression", CompressionType)
@pytest.mark.parametrize("options", [{}, {"chunk_size": 1000}, {"use_chunking": False}])
def test_log_by_the_mcap_package_is_read(rows, tmp_path, compression, options):
    data = mcap_bytes(lambda w: write_rows(w, rows), compression=compression, **options)
    log = read_bytes(tmp_path, data)
    assert log.complete
    assert log.rows.tobytes() == rows.tobytes()
    # Without the metadata "levid", the rate follows from the log times, 1 ms apart.
    assert log.rate_hz == pytest.approx(1000.0)
    assert (log.metadata, log.schema_name) == ({}, "x/msg/Y")


def test_log_without_summary_and_index_is_read(rows, tmp_path):
    data = mcap_bytes(
        lambda w: write_rows(w, rows),
        index_types=IndexType.NONE,
        repeat_channels=False,
        repeat_schemas=False,
        use_statistics=False,
        use_summary_offsets=False,
        enable_crcs=False,
    )
    log = read_bytes(tmp_path, data)
    assert log.complete
    assert log.rows.tobytes() == rows.tobytes()


def test_damage_outside_of_chunks_is_detected_by_the_crc_of_the_data_section(rows, tmp_path):
    data = mcap_bytes(lambda w: write_rows(w, rows), use_chunking=False, enable_data_crcs=True)
    assert read_bytes(tmp_path, data).complete
    at = data.index(rows[200].tobytes()) + 50
    log = read_bytes(tmp_path, data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    assert not log.complete
    assert "data section: damaged: expected CRC" in log.problem


def test_truncated_foreign_log_gives_its_complete_chunks(rows, tmp_path):
    data = mcap_bytes(lambda w: write_rows(w, rows), chunk_size=5000)
    log = read_bytes(tmp_path, data[: chunks_of(data)[3][1] + 10])
    assert not log.complete
    assert 0 < log.rows.size < rows.size
    assert log.rows.tobytes() == rows[: log.rows.size].tobytes()


def test_lz4_frames_without_a_stored_size_are_read(rows, tmp_path, monkeypatch):
    compress = lz4.frame.compress
    monkeypatch.setattr(lz4.frame, "compress", lambda data: compress(data, store_size=False))
    data = mcap_bytes(lambda w: write_rows(w, rows), compression=CompressionType.LZ4)
    assert read_bytes(tmp_path, data).rows.tobytes() == rows.tobytes()


def test_cycle_rows_are_read_between_messages_of_other_channels(rows, tmp_path):
    def build(writer):
        names = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        chatter = writer.register_channel("/chatter", "cdr", names)
        other = writer.register_schema("a/msg/B", "ros2msg", b"float64 temperature_k")
        heat = writer.register_channel("/heat", "cdr", other)
        schema = writer.register_schema("x/msg/Y", "ros2msg", ros2msg(DTYPE).encode())
        cycle = writer.register_channel("/levid/cycle", "cdr", schema)
        for number, row in enumerate(rows):
            time = int(times_of(number + 1)[-1])
            if number % 3 == 0:
                text = b"\0\1\0\0" + struct.pack("<I", 1 + number) + b"x" * number + b"\0"
                writer.add_message(chatter, time, text, time, number)
            if number % 50 < 3:
                writer.add_message(heat, time, b"\0\1\0\0" + bytes(8), time, number)
            writer.add_message(cycle, time, b"\0\1\0\0" + row.tobytes(), time, number)

    for options in ({"chunk_size": 4000}, {"use_chunking": False}):
        log = read_bytes(tmp_path, mcap_bytes(build, **options))
        assert log.complete
        assert log.rows.tobytes() == rows.tobytes()
        np.testing.assert_array_equal(log.log_time_ns, times_of(rows.size))


def test_single_channel_of_fixed_size_is_read_and_two_are_ambiguous(tmp_path):
    text = "float64 force\nuint8 flag\nfloat32 gap"
    foreign = some_rows(20, dtype_from_ros2msg(text))

    def one(writer):
        write_rows(writer, foreign, topic="/bench", text=text)

    def two(writer):
        one(writer)
        write_rows(writer, foreign, topic="/other", text=text)

    log = read_bytes(tmp_path, mcap_bytes(one))
    assert log.rows.dtype.names == ("force", "flag", "gap")
    for name in log.rows.dtype.names:
        np.testing.assert_array_equal(log.rows[name], foreign[name])
    with pytest.raises(LogError, match=r"expected one channel .*/bench, /other"):
        read_bytes(tmp_path, mcap_bytes(two))


def test_big_endian_messages_are_converted_to_little_endian(rows, tmp_path):
    swapped = rows.astype(DTYPE.newbyteorder(">"))
    text = ros2msg(DTYPE)
    data = mcap_bytes(lambda w: write_rows(w, swapped, text=text, head=b"\0\0\0\0"))
    log = read_bytes(tmp_path, data)
    assert log.rows.dtype == DTYPE
    assert log.rows.tobytes() == rows.tobytes()


def test_padding_after_the_last_field_is_ignored(tmp_path):
    text = "float64 force\nuint8 flag"  # 9 bytes; some writers pad to 12
    foreign = some_rows(20, dtype_from_ros2msg(text))
    data = mcap_bytes(lambda w: write_rows(w, foreign, text=text, tail=bytes(3)))
    assert read_bytes(tmp_path, data).rows.tobytes() == foreign.tobytes()


def test_messages_that_do_not_fit_their_schema_are_rejected(rows, tmp_path):
    short = mcap_bytes(
        lambda w: write_rows(w, some_rows(9, cycle_dtype(2, 3)), text=ros2msg(DTYPE))
    )
    with pytest.raises(LogError, match=r"expected messages of \d+ bytes, as their schema says"):
        read_bytes(tmp_path, short)
    parameter_list = mcap_bytes(lambda w: write_rows(w, rows, head=b"\0\3\0\0"))
    with pytest.raises(LogError, match="found 00 03"):
        read_bytes(tmp_path, parameter_list)


def test_unreadable_schemas_and_files_are_rejected(tmp_path):
    def json(writer):
        schema = writer.register_schema("x", "jsonschema", b"{}")
        writer.add_message(writer.register_channel("/x", "json", schema), 0, b"{}", 0)

    def nested(writer):
        schema = writer.register_schema("x/msg/Y", "ros2msg", b"std_msgs/Header header")
        writer.add_message(writer.register_channel("/x", "cdr", schema), 0, bytes(8), 0)

    def empty(writer):
        write_rows(writer, some_rows(0))

    with pytest.raises(
        LogError,
        match=r"/x: expected messages in cdr and a schema in ros2msg, found json and jsonschema",
    ):
        read_bytes(tmp_path, mcap_bytes(json))
    with pytest.raises(LogError, match=r"/x: schema: field 'header'.*nested"):
        read_bytes(tmp_path, mcap_bytes(nested))
    with pytest.raises(LogError, match=r"expected messages on /levid/cycle, found none"):
        read_bytes(tmp_path, mcap_bytes(empty))
    with pytest.raises(LogError, match="expected a channel with messages, found none"):
        read_bytes(tmp_path, mcap_bytes(lambda _: None))
    with pytest.raises(LogError, match="found an empty file"):
        read_bytes(tmp_path, b"")
    with pytest.raises(LogError, match=r"expected an MCAP log, found another kind of file"):
        read_bytes(tmp_path, b"levid: session\n")
    with pytest.raises(LogError, match=r"missing\.mcap: cannot be read: No such file"):
        read_log(tmp_path / "missing.mcap")
    with pytest.raises(LogError, match=r"found a folder: give the logs in it, as FOLDER/\*\.mcap"):
        read_log(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(LogError, match="expected a file, found a pipe"):
        read_log(tmp_path / "pipe")


def test_unknown_rate_is_rejected(rows, tmp_path):
    def with_equal_times(writer):
        schema = writer.register_schema("x/msg/Y", "ros2msg", ros2msg(DTYPE).encode())
        channel = writer.register_channel("/levid/cycle", "cdr", schema)
        for row in rows:
            writer.add_message(channel, 5, b"\0\1\0\0" + row.tobytes(), 5)

    def with_invalid_rate(writer):
        writer.add_metadata("levid", {"rate_hz": "fast"})
        write_rows(writer, rows)

    with pytest.raises(LogError, match="expected rate_hz in a Metadata record"):
        read_bytes(tmp_path, mcap_bytes(with_equal_times))
    with pytest.raises(LogError, match="rate_hz: expected a positive number, found 'fast'"):
        read_bytes(tmp_path, mcap_bytes(with_invalid_rate))


def test_private_record_between_chunks_is_skipped(path, rows, tmp_path):
    data = path.read_bytes()
    (_, before), (_, end) = chunks_of(data)[-2:]
    private = RECORD_HEAD.pack(0x90, 3) + b"abc"
    # The summary is cut off, because its offsets would be wrong.
    log = read_bytes(tmp_path, data[:before] + private + data[before:end])
    assert log.rows.tobytes() == rows.tobytes()


def test_levid_log_copied_by_another_tool_is_read(path, rows, tmp_path):
    # MCAP's tools for recovery and filtering copy every record, including levid's checksum of the
    # preceding bytes, which are then different.
    def copied(writer):
        for metadata in make_reader(io.BytesIO(path.read_bytes())).iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        write_rows(writer, rows)

    log = read_bytes(tmp_path, mcap_bytes(copied))
    assert log.complete
    assert log.rows.tobytes() == rows.tobytes()
    assert log.metadata == read_log(path).metadata


def test_statistics_without_message_counts_are_ignored(rows, tmp_path):
    def build(writer):
        write_rows(writer, rows)
        writer._Writer__statistics.channel_message_counts.clear()

    assert read_bytes(tmp_path, mcap_bytes(build)).complete


def test_messages_outside_of_chunks_are_read_in_parts(rows, tmp_path, monkeypatch):
    data = mcap_bytes(lambda w: write_rows(w, rows), use_chunking=False)
    monkeypatch.setattr(mcap_scan, "_RUN_BYTES", 3000)
    monkeypatch.setattr(mcap_scan, "MAX_CHUNK_BYTES", 10_000)
    assert len(scan(memoryview(data)).chunks) > 10
    log = read_bytes(tmp_path, data)
    assert log.complete
    assert log.rows.tobytes() == rows.tobytes()
