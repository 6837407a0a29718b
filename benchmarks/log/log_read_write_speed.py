"""Log writing and reading, against the MCAP libraries that one would otherwise take."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray

from levid.benchmarks.harness.benchmark_runner import Figure, median_times, run
from levid.log.reader import read_log
from levid.log.signals import cycle_dtype, ros2msg
from levid.log.writer import LogWriter

RATE_HZ = 10_000
BLOCK = 1000
COILS = SENSORS = 9


def flight(count: int) -> NDArray[np.void]:
    """Return rows like those of a flight under white noise: drift, noise, constant columns."""
    rng = np.random.default_rng(1)
    rows = np.zeros(count, cycle_dtype(COILS, SENSORS))
    rows["cycle"] = np.arange(count)
    rows["time_s"] = np.arange(count) / RATE_HZ
    step_m = 2e-3 / 2**16
    drift = 1e-7 * np.cumsum(rng.standard_normal((count, SENSORS)), axis=0)
    gap_m = step_m * np.round((drift + 1e-7 * rng.standard_normal(drift.shape)) / step_m)
    rows["gap_m"] = gap_m
    for name, column in (("psi_rad", 0), ("theta_rad", 1), ("z_m", 2)):
        rows[name] = gap_m[:, column::3].mean(axis=1)
    rows["v_psi_n_m"] = 0.1 * rng.standard_normal(count)
    rows["ff_z_n"] = 68.7
    rows["tau_psi_n_m"] = rows["v_psi_n_m"] - 20 * rows["psi_rad"]
    rows["tau_theta_n_m"] = -20 * rows["theta_rad"]
    rows["tau_z_n"] = rows["ff_z_n"] - 500 * rows["z_m"]
    wrench = np.stack([rows["tau_psi_n_m"], rows["tau_theta_n_m"], rows["tau_z_n"]], axis=1)
    rows["coil_n"] = wrench @ rng.standard_normal((3, COILS))
    rows["coil_readback_n"] = rows["coil_n"] + 1e-3 * rng.standard_normal((count, COILS))
    rows["beam_m"] = 0.05 + 1e-6 * rng.standard_normal(count)
    rows["beam_force_n"] = 0.01 * rng.standard_normal(count)
    rows["rotor_torque_n_m"] = 1e-3 * rng.standard_normal(count)
    rows["lateness_s"] = 1e-5 * np.abs(rng.standard_normal(count))
    rows["execution_s"] = 4e-6 + 1e-6 * np.abs(rng.standard_normal(count))
    rows["state"] = 3
    return rows


def measure(quick: bool) -> Sequence[Figure]:
    count, repeats = (50_000, 3) if quick else (100_000, 9)
    few = 2000 if quick else 10_000
    rows = flight(count)
    times = (rows["time_s"] * 1e9).astype(np.uint64)
    with tempfile.TemporaryDirectory() as folder:
        paths = (Path(folder) / f"{number}.mcap" for number in itertools.count())
        log, slow = next(paths), next(paths)
        _write_levid(log, rows, times)
        _write_levid(slow, rows, times, rate_hz=1000)  # chunks of 500 rows instead of 5000
        read_log(log)  # imports and page cache
        seconds = median_times(
            {
                "read": lambda: read_log(log),
                "iterate": lambda: _exhaust(log, count),
                "read_1khz": lambda: read_log(slow),
                "iterate_1khz": lambda: _exhaust(slow, count),
                "decode": lambda: _decode(log, few),
                "write": lambda: _write_levid(next(paths), rows, times),
                "writer": lambda: _write_mcap(next(paths), rows[:few], times[:few]),
            },
            repeats,
        )
        size = log.stat().st_size / count
    short = {"decode", "writer"}
    rate = {name: (few if name in short else count) / value for name, value in seconds.items()}
    labels = {
        "read": ("levid, into arrays", "iterate"),
        "iterate": ("mcap's iterator, not decoded", None),
        "read_1khz": ("levid, chunks of a 1 kHz log", "iterate_1khz"),
        "iterate_1khz": ("mcap's iterator, 1 kHz log", None),
        "decode": ("mcap + mcap-ros2-support", None),
        "write": ("levid's writer", "writer"),
        "writer": ("mcap's writer", None),
    }
    rates = [
        Figure(
            f"{name}_records_per_s",
            rate[name],
            "records/s",
            label,
            versus and f"{versus}_records_per_s",
        )
        for name, (label, versus) in labels.items()
    ]
    return [
        *rates,
        Figure("read_over_iterate", rate["read"] / rate["iterate"], "", "reading / iterator"),
        Figure(
            "read_1khz_over_iterate",
            rate["read_1khz"] / rate["iterate_1khz"],
            "",
            "reading / iterator, 1 kHz log",
        ),
        Figure("read_over_decode", rate["read"] / rate["decode"], "", "reading / ros2-support"),
        Figure("write_over_writer", rate["write"] / rate["writer"], "", "writing / mcap's writer"),
        Figure("file_bytes_per_record", size, "bytes", "on disk, a record", "record_bytes"),
        Figure("record_bytes", rows.dtype.itemsize, "bytes", "the record itself"),
    ]


def _write_levid(
    path: Path, rows: NDArray[np.void], times: NDArray[np.uint64], rate_hz: float = RATE_HZ
) -> None:
    with LogWriter(path, rows.dtype, rate_hz=rate_hz, metadata={}, attachments={}) as log:
        for begin in range(0, rows.size, BLOCK):
            log.write(rows[begin : begin + BLOCK], times[begin : begin + BLOCK])


def _write_mcap(path: Path, rows: NDArray[np.void], times: NDArray[np.uint64]) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema("levid/msg/Cycle", "ros2msg", ros2msg(rows.dtype).encode())
        channel = writer.register_channel("/levid/cycle", "cdr", schema)
        for number, (row, time) in enumerate(zip(rows, times.tolist(), strict=True)):
            writer.add_message(channel, time, b"\0\1\0\0" + row.tobytes(), time, number)
        writer.finish()


def _exhaust(path: Path, count: int) -> None:
    with path.open("rb") as file:
        found = sum(1 for _ in make_reader(file).iter_messages())
    assert found == count


def _decode(path: Path, count: int) -> None:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages: Iterator[object] = iter(reader.iter_decoded_messages())
        for _ in range(count):
            next(messages)


if __name__ == "__main__":
    run("Log: writing and reading", measure)
