"""Test the log writer: its files as other MCAP readers read them."""

from __future__ import annotations

import errno
import itertools

import numpy as np
import pytest
import yaml
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk, MessageIndex
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

from levid.log.errors import LogError
from levid.log.mcap_scan import HEAD
from levid.log.reader import read_log
from levid.log.signals import cycle_dtype, ros2msg
from levid.log.writer import FIRST_CHUNK_ROWS, MAX_CHUNK_ROWS, LogWriter

DTYPE = cycle_dtype(9, 9)
START_NS = 1_700_000_000_000_000_000


def random_rows(count, dtype=DTYPE, seed=1):
    """Return rows of random bits, including NaN and infinity, numbered from 2**32 - 100."""
    bits = np.random.default_rng(seed).integers(0, 256, (count, dtype.itemsize), np.uint8)
    rows = bits.view(dtype)[:, 0]
    rows["cycle"] = np.arange(count) + 2**32 - 100
    return rows


def times_of(count, step_ns=100_000):
    return START_NS + step_ns * np.arange(count, dtype=np.uint64)


def write(path, rows, times, *, rate_hz=1000.0, block=333, **options):
    options = {"metadata": {"kind": "record"}, "attachments": {}} | options
    options = {"chunk_s": 0.5, **options}
    with LogWriter(path, rows.dtype, rate_hz=rate_hz, **options) as log:
        for begin in range(0, rows.size, block):
            log.write(rows[begin : begin + block], times[begin : begin + block])
    return path


@pytest.fixture(scope="module")
def rows():
    return random_rows(2300)


@pytest.fixture(scope="module")
def path(rows, tmp_path_factory):
    return write(
        tmp_path_factory.mktemp("log") / "a.mcap",
        rows,
        times_of(rows.size),
        metadata={"kind": "record", "name": "left-psi"},
        attachments={"rig.yaml": b"levid: rig\n", "host.json": b"{}"},
    )


def test_mcap_ros2_decoder_reads_every_field_of_every_row(path, rows):
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages())
    assert len(decoded) == rows.size
    for number, (item, row) in enumerate(zip(decoded, rows, strict=True)):
        assert item.message.log_time == item.message.publish_time == START_NS + 100_000 * number
        assert item.message.sequence == int(row["cycle"]) & 0xFFFFFFFF
        for name in DTYPE.names:
            np.testing.assert_array_equal(
                np.array(getattr(item.decoded_message, name), DTYPE[name].base), row[name]
            )


def test_streaming_reader_finds_correct_crcs_and_record_order(path, rows):
    with path.open("rb") as file:
        records = list(StreamReader(file, validate_crcs=True, emit_chunks=True).records)
    kinds = [kind for kind, _ in itertools.groupby(type(r).__name__ for r in records)]
    assert kinds[:7] == [
        "Header",
        "Schema",
        "Channel",
        "Attachment",
        "Metadata",
        "Chunk",
        "MessageIndex",
    ]
    assert records[0].profile == "ros2"
    # What the registry's profile ros2 requires of a channel.
    (quality,) = yaml.safe_load(records[2].metadata["offered_qos_profiles"])
    assert (quality["reliability"], quality["durability"], quality["history"]) == (1, 2, 1)
    with path.open("rb") as file:
        reader = NonSeekingReader(file, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages(log_time_order=False)) == rows.size


def test_summary_agrees_with_the_file(path, rows):
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attachments = {record.name: record.data for record in reader.iter_attachments()}
    statistics = summary.statistics
    assert statistics.message_count == rows.size
    assert statistics.channel_message_counts == {1: rows.size}
    # 32, 32, 64, 128, 256, three times 500, and 288 rows.
    assert statistics.chunk_count == len(summary.chunk_indexes) == 9
    assert (statistics.schema_count, statistics.channel_count) == (1, 1)
    assert (statistics.attachment_count, statistics.metadata_count) == (3, 2)
    assert statistics.message_start_time == START_NS
    assert statistics.message_end_time == START_NS + 100_000 * (rows.size - 1)
    assert metadata["levid"] == {
        "format": "1",
        "kind": "record",
        "name": "left-psi",
        "rate_hz": "1000.0",
    }
    head = attachments.pop(HEAD)
    assert attachments == {"rig.yaml": b"levid: rig\n", "host.json": b"{}"}
    assert head == path.read_bytes()[: len(head)]
    assert int(metadata[HEAD]["bytes"]) < len(head)
    (channel,) = summary.channels.values()
    (schema,) = summary.schemas.values()
    assert (channel.topic, channel.message_encoding) == ("/levid/cycle", "cdr")
    assert (schema.name, schema.encoding) == ("levid/msg/Cycle", "ros2msg")
    assert schema.data.decode() == ros2msg(DTYPE)


def test_index_has_the_offset_of_each_chunk_and_message(path):
    with path.open("rb") as file:
        indexes = make_reader(file).get_summary().chunk_indexes
        for index in indexes:
            file.seek(index.chunk_start_offset)
            records = StreamReader(file, skip_magic=True, emit_chunks=True).records
            chunk, messages = next(records), next(records)
            assert isinstance(chunk, Chunk)
            assert isinstance(messages, MessageIndex)
            assert chunk.message_start_time == index.message_start_time == messages.records[0][0]
            assert chunk.message_end_time == index.message_end_time == messages.records[-1][0]
            assert (chunk.uncompressed_size, len(chunk.data)) == (
                index.uncompressed_size,
                index.compressed_size,
            )
        # A query by time goes through these indexes and the message offsets.
        file.seek(0)
        found = make_reader(file).iter_messages(
            starting_at=START_NS + 700 * 100_000, ending_before=START_NS + 1200 * 100_000
        )
        assert [m.log_time for _, _, m in found] == times_of(1200)[700:].tolist()


def test_file_is_independent_of_the_size_of_writes(path, rows, tmp_path):
    again = write(
        tmp_path / "b.mcap",
        rows,
        times_of(rows.size),
        block=17,
        metadata={"kind": "record", "name": "left-psi"},
        attachments={"rig.yaml": b"levid: rig\n", "host.json": b"{}"},
    )
    assert again.read_bytes() == path.read_bytes()


def test_existing_file_is_not_overwritten(path, rows):
    before = path.read_bytes()
    with pytest.raises(LogError, match="exists"):
        LogWriter(path, DTYPE, rate_hz=1000, chunk_s=0.5, metadata={}, attachments={})
    assert path.read_bytes() == before


def test_chunks_have_at_most_their_duration_and_8192_rows(tmp_path):
    for rate_hz, expected in ((10.0, 9), (1000.0, 900), (100_000.0, MAX_CHUNK_ROWS)):
        path = tmp_path / f"{rate_hz}.mcap"
        rows = random_rows(4 * expected)
        with LogWriter(path, DTYPE, rate_hz=rate_hz, metadata={}, attachments={}) as log:
            log.write(rows, times_of(rows.size))
        with path.open("rb") as file:
            chunks = make_reader(file).get_summary().chunk_indexes
        counts = [c.message_index_length // 16 for c in chunks]
        assert max(counts) == expected
        assert counts[0] == min(FIRST_CHUNK_ROWS, expected)
        # None holds more than all before it.
        assert all(n <= sum(counts[:i]) for i, n in enumerate(counts) if i)


def test_log_without_close_has_its_complete_chunks(tmp_path, rows):
    log = LogWriter(
        tmp_path / "a.mcap",
        DTYPE,
        rate_hz=1000,
        chunk_s=0.5,
        metadata={},
        attachments={"a.txt": b"x"},
    )
    log.write(rows[:1750], times_of(1750))
    # Without close: the file as a killed process leaves it. The first 512 rows are in five chunks.
    found = read_log(log.path)
    assert not found.complete
    assert found.rows.tobytes() == rows[:1512].tobytes()
    assert found.attachments == {"a.txt": b"x"}
    log.close()
    assert read_log(log.path).complete


def test_log_is_complete_after_an_exception(tmp_path, rows):
    path = tmp_path / "a.mcap"

    def fly():
        with LogWriter(path, DTYPE, rate_hz=1000, chunk_s=0.5, metadata={}, attachments={}) as log:
            log.write(rows[:700], times_of(700))
            raise RuntimeError("the loop failed")

    with pytest.raises(RuntimeError, match="the loop failed"):
        fly()
    found = read_log(path)
    assert found.complete
    assert found.rows.size == 700


def test_rows_of_another_dtype_and_writes_after_close_are_rejected(tmp_path, rows):
    log = LogWriter(
        tmp_path / "a.mcap", DTYPE, rate_hz=1000, chunk_s=0.5, metadata={}, attachments={}
    )
    other = np.zeros(3, cycle_dtype(4, 4))
    sizes = f"{DTYPE.itemsize} bytes .*found {other.dtype.itemsize} bytes"
    with pytest.raises(LogError, match=sizes):
        log.write(other, times_of(3))
    with pytest.raises(LogError, match=r"times \(n,\)"):
        log.write(rows[:3], times_of(2))
    log.close()
    log.close()
    with pytest.raises(LogError, match="closed"):
        log.write(rows[:3], times_of(3))


class FullDisk:
    """A file on a disk with `room` free bytes."""

    def __init__(self, file, free_bytes):
        self.file, self.free_bytes = file, free_bytes

    @property
    def closed(self):
        return self.file.closed

    def close(self):
        self.file.close()

    def write(self, data):
        if not self.free_bytes:
            raise OSError(errno.ENOSPC, "No space left on device")
        count = self.file.write(data[: self.free_bytes])
        self.free_bytes -= count
        return count


def test_full_disk_gives_an_error_and_a_log_of_complete_chunks(tmp_path, rows):
    path = tmp_path / "a.mcap"

    def fly():
        with LogWriter(path, DTYPE, rate_hz=1000, chunk_s=0.5, metadata={}, attachments={}) as log:
            log.write(rows[:1000], times_of(1000))
            log._file = FullDisk(log._file, 5000)  # random bits: a chunk is about 150 kB
            log.write(rows[1000:1500], times_of(500))

    with pytest.raises(LogError, match=r"a\.mcap: cannot be written: No space left"):
        fly()
    found = read_log(path)
    assert not found.complete
    assert found.rows.tobytes() == rows[:512].tobytes()


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, np.nan, np.inf])
def test_invalid_rate_is_rejected_without_creating_a_file(tmp_path, rate_hz):
    with pytest.raises(LogError, match="positive rate"):
        LogWriter(tmp_path / "a.mcap", DTYPE, rate_hz=rate_hz, metadata={}, attachments={})
    assert not list(tmp_path.iterdir())


def test_missing_folder_is_reported(tmp_path):
    with pytest.raises(LogError, match="cannot be created: No such file"):
        LogWriter(tmp_path / "no" / "a.mcap", DTYPE, rate_hz=1, metadata={}, attachments={})
