"""Files with changed bytes end in an error of levid or in a right result, never in another error.

`pytest --hypothesis-profile=million -k fuzz` runs a thousand times as many.
"""

from __future__ import annotations

import contextlib
import functools
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st

from levid.log.errors import LogError
from levid.log.importing.array_variables import load_mat, load_npz, read_variables
from levid.log.importing.delimited_text import read_delimited
from levid.log.importing.signals_yaml import SignalsFile
from levid.log.reader import read_log
from levid.log.salvage import salvage
from levid.log.signals import cycle_dtype
from levid.log.writer import LogWriter

DTYPE = cycle_dtype(3, 3)
SIGNALS = SignalsFile.model_validate(
    {
        "levid": "signals",
        "rate_hz": 100,
        "columns": [
            {"column": "a", "name": "a", "unit": "V", "role": "input"},
            {"column": "b", "name": "b", "unit": "V", "role": "output"},
        ],
    }
)
CHANGES = st.lists(
    st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255), st.integers(0, 40)),
    min_size=1,
    max_size=6,
)
"""Of each change: where in the file, a byte, and how many bytes are cut out there."""


def changed(data: bytes, changes: list[tuple[float, int, int]]) -> bytes:
    found = bytearray(data)
    for share, byte, cut in changes:
        if not found:
            break
        at = int(share * len(found))
        if cut > 30:
            del found[at : at + cut]
        else:
            found[at : at + 1 + cut // 10] = bytes([byte]) * (1 + cut // 10)
    return bytes(found)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@functools.cache
def log_rows() -> np.ndarray:
    rows = np.zeros(300, DTYPE)
    rows["cycle"] = 100 + np.arange(300)
    rows["gap_m"] = np.random.default_rng(1).normal(size=(300, 3))
    return rows


@pytest.fixture(scope="module")
def log(folder: Path) -> bytes:
    path = folder / "right.mcap"
    with LogWriter(
        path, DTYPE, rate_hz=1000, chunk_s=0.05, metadata={}, attachments={"a.txt": b"abc"}
    ) as writer:
        writer.write(log_rows(), np.arange(300, dtype=np.uint64))
    return path.read_bytes()


@given(changes=CHANGES)
def test_log_gives_its_rows_or_an_error_of_levid(log, folder, changes) -> None:
    path = folder / "changed.mcap"
    path.write_bytes(changed(log, changes))
    rows = log_rows()
    with contextlib.suppress(LogError):
        found = read_log(path)
        assert len(found.rows) <= len(rows)
    with contextlib.suppress(LogError):
        saved = salvage(path).rows
        at = saved["cycle"].astype(int) - 100
        assert np.all((at >= 0) & (at < 300))
        assert saved.tobytes() == rows[at].tobytes()


def arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(2)
    return {"a": rng.normal(size=80), "b": rng.normal(size=80)}


@pytest.fixture(scope="module", params=["stored", "compressed"])
def npz(request: pytest.FixtureRequest) -> bytes:
    file = io.BytesIO()
    (np.savez if request.param == "stored" else np.savez_compressed)(file, **arrays())
    return file.getvalue()


@given(changes=CHANGES)
def test_npz_gives_its_columns_or_an_error_of_levid(npz, folder, changes) -> None:
    path = folder / "changed.npz"
    path.write_bytes(changed(npz, changes))
    with contextlib.suppress(LogError):
        for column in read_variables(path, SIGNALS, load_npz(path)):
            assert column.ndim == 1


@given(data=st.binary(max_size=300), name=st.sampled_from(["a.npy", "b.npy", "a", "x.npy"]))
def test_archive_of_nonsense_gives_an_error_of_levid(folder, data, name) -> None:
    path = folder / "nonsense.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, data)
    with pytest.raises(LogError):
        read_variables(path, SIGNALS, load_npz(path))


@pytest.fixture(scope="module")
def mat() -> bytes:
    file = io.BytesIO()
    scipy.io.savemat(file, arrays(), do_compression=True)
    return file.getvalue()


@given(changes=CHANGES)
def test_compressed_mat_file_gives_its_columns_or_an_error_of_levid(mat, folder, changes) -> None:
    """In this process, where zlib's check keeps damage from scipy's reader: see its own tests."""
    path = folder / "changed.mat"
    path.write_bytes(mat[:136] + changed(mat[136:], changes))  # not the header and the first tag
    with contextlib.suppress(LogError, MemoryError):
        read_variables(path, SIGNALS, load_mat(path))


@given(changes=CHANGES)
def test_text_gives_its_columns_or_an_error_of_levid(folder, changes) -> None:
    lines = ["a,b", *(f"{i},{0.5 * i:.3f}" for i in range(60))]
    path = folder / "changed.csv"
    path.write_bytes(changed("\n".join(lines).encode(), changes))
    with contextlib.suppress(LogError):
        columns = read_delimited(path, SIGNALS, whitespace=False).values
        assert all(column.dtype == np.float64 for column in columns)
