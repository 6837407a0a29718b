"""Files with absurd lengths end in a result or an error of levid, with bounded memory and time.

`pytest --hypothesis-profile=million -k fuzz` reads a thousand times as many.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from pathlib import Path

import file_length_fuzz
import numpy as np
import pytest
from file_length_fuzz import MOST_BYTES, mat_file, mutated
from hypothesis import settings

from levid.log.errors import LogError
from levid.log.importing.mat_file_reader import list_mat


def test_files_with_absurd_lengths_fuzz(tmp_path: Path) -> None:
    count = max(settings().max_examples // 25, 10)
    command = [sys.executable, file_length_fuzz.__file__, str(tmp_path), str(count), "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"a file took too long, or crashed its reader: {done.stderr}"
    found = json.loads(done.stdout)
    assert found["failures"] == []
    # Most of it are the files themselves and what their readers import later.
    assert found["bytes"] < MOST_BYTES / 2


@pytest.mark.parametrize("seed", range(4))
def test_mat_file_with_absurd_lengths_fuzz(seed: int, tmp_path: Path) -> None:
    path = tmp_path / "changed.mat"
    path.write_bytes(mutated(mat_file(), np.random.default_rng(seed)))
    with contextlib.suppress(LogError):
        list_mat(path)


@pytest.mark.parametrize("shape", [(2**60,), (2**40,), (2**31, 2**31), (-1,), (2**62, 4)])
@pytest.mark.parametrize("version", [1, 2])
def test_npy_file_that_states_an_absurd_shape_names_it(
    shape: tuple[int, ...], version: int, tmp_path: Path
) -> None:
    from levid.log.importing.array_variables import load_npz

    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    length = len(head).to_bytes(2 if version == 1 else 4, "little")
    path = tmp_path / "a.npy"
    path.write_bytes(b"\x93NUMPY" + bytes([version, 0]) + length + head + bytes(80))
    with pytest.raises(LogError, match="not a usable NPZ file"):
        load_npz(path)
