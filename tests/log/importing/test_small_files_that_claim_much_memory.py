"""Test that small files which unpack to gigabytes end in an error, with little memory and time.

Each command is a process of its own, whose peak memory includes that of its children.
"""

from __future__ import annotations

import functools
import io
import os
import re
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from mcap.records import Channel, Chunk, Header, Schema
from mcap.writer import MCAP0_MAGIC
from measured_command import levid
from zstandard import ZstdCompressor

from levid.log.writer import record_bytes

LIMIT_BYTES = 300e6
COSTS = 6.0
"""Processor time for a file that claims much, over that for a right one in the same run."""
SIGNALS = "levid: signals\nrate_hz: 100\ncolumns:\n- {column: a, name: a, unit: V, role: input}\n"


@pytest.fixture(scope="module")
def start_cost(tmp_path_factory):
    """Return what the same command takes for a file that is right: most is Python's start."""
    folder = tmp_path_factory.mktemp("right")
    (folder / "s.yaml").write_text(SIGNALS)
    np.savez(folder / "a.npz", a=np.random.default_rng(0).normal(size=2000))
    scipy.io.savemat(folder / "a.mat", {"a": np.random.default_rng(0).normal(size=2000)})
    costs = []
    for name in ("a.npz", "a.mat"):
        code, text, _, cpu_s = levid(
            "import", folder / name, "--signals", folder / "s.yaml", "-o", folder / f"{name}.mcap"
        )
        assert code == 0, text
        costs.append(cpu_s)
    return max(costs)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return a function that returns the bytes which one of the functions below writes."""
    folder = tmp_path_factory.mktemp("written")

    @functools.cache
    def written(write):
        write(folder / write.__name__)
        return (folder / write.__name__).read_bytes()

    return written


def zeros_npz(path):
    """Write an array of 400 MB, piece by piece."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (50_000_000,)}
    )
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("a.npy", "w", force_zip64=True) as member,
    ):
        member.write(header.getvalue())
        for _ in range(50):
            member.write(bytes(8_000_000))


def claiming_npz(path):
    """Write an array whose header claims 1.8 GB, of which nothing follows."""
    with zipfile.ZipFile(path, "w") as archive, archive.open("a.npy", "w") as member:
        np.lib.format.write_array_header_1_0(
            member, {"descr": "<f8", "fortran_order": False, "shape": (225_000_000,)}
        )


def zeros_mat(path):
    arrays = {f"a{i}": np.zeros(5_000_000) for i in range(10)}
    scipy.io.savemat(path, arrays, appendmat=False, do_compression=True)


def zeros_mcap(path):
    size = 200 << 20
    packed = ZstdCompressor().compress(bytes(size))
    chunks = [Chunk("zstd", packed, 0, 0, 0, size) for _ in range(9)]
    schema = Schema(1, b"float64 a", "ros2msg", "x/msg/Y")
    channel = Channel(1, "/x", "cdr", {}, 1)
    path.write_bytes(MCAP0_MAGIC + record_bytes(Header("ros2", ""), schema, channel, *chunks))


@pytest.mark.parametrize(
    ("write", "name", "verb", "expected"),
    [
        (zeros_npz, "a.npz", "import", "expected at most .* when unpacked in a file of"),
        (claiming_npz, "a.npz", "import", "not a usable NPZ file"),
        (zeros_mat, "a.mat", "import", "a MAT file that unpacks into memory in proportion"),
        (zeros_mat, "a.mat", "new", "a MAT file that unpacks into memory in proportion"),
        (zeros_mcap, "a.mcap", "check", "expected at most .* when unpacked in a file of"),
        (zeros_mcap, "a.mcap", "salvage", "no undamaged chunk"),
    ],
)
def test_error_in_little_memory_and_time(
    tmp_path, start_cost, written, write, name, verb, expected
):
    file = tmp_path / name
    file.write_bytes(written(write))
    assert file.stat().st_size < 4e6
    (tmp_path / "s.yaml").write_text(SIGNALS)
    options = {
        "import": ("import", file, "--signals", tmp_path / "s.yaml", "-o", tmp_path / "o.mcap"),
        "new": ("new", "signals", file, "-o", tmp_path / "n.yaml"),
    }.get(verb, (verb, file))
    code, text, peak, cpu_s = levid(*options)
    assert code == 1
    assert re.search(expected, text), text
    assert "Traceback" not in text
    assert peak < LIMIT_BYTES
    assert cpu_s < COSTS * start_cost
    assert not (tmp_path / "o.mcap").exists()


@pytest.mark.parametrize("wait_s", [0.0, 3.0])
def test_reader_of_a_mat_file_ends_with_its_parent(tmp_path, wait_s):
    """SIGTERM ends the command only; its child must not go on alone, whatever it has done so far.

    After 3 s it usually waits for a writer of the file.
    """
    file = tmp_path / "a.mat"
    os.mkfifo(file)
    parent = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import sys; from pathlib import Path; "
            "from levid.log.importing.mat_file_reader import list_mat; list_mat(Path(sys.argv[1]))",
            str(file),
        ],
        stderr=subprocess.DEVNULL,
    )
    try:
        children, deadline = "", time.monotonic() + 60
        while not children and time.monotonic() < deadline:
            time.sleep(0.05)
            children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().strip()
        waits = Path(f"/proc/{int(children)}/stat")
        time.sleep(wait_s)
        assert waits.exists()
    finally:
        parent.send_signal(signal.SIGTERM)
        parent.wait(60)
    deadline = time.monotonic() + 30
    while waits.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not waits.exists()
