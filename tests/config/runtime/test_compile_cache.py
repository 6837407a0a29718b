"""Test that compiled code is loaded from files that are whole and this user's alone, or not."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from numba import njit

from levid.config.runtime import compile_cache
from levid.config.runtime.compile_cache import CheckedCache, cache_folder, source_stamp

GAIN = 3


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return the folder of the cache, below $NUMBA_CACHE_DIR."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    cache_folder.cache_clear()
    found = cache_folder()
    assert found is not None
    assert found.is_relative_to(tmp_path)
    yield found
    cache_folder.cache_clear()


def tripled(x: float) -> float:
    return GAIN * x


def compiled() -> Callable[[float], float]:
    """Return the function as another process has it: compiled by no call before."""
    made = njit(cache=True)(tripled)
    assert isinstance(made._cache, CheckedCache)
    return made


def hits(function: Callable[[float], float]) -> int:
    """Return how many signatures were loaded from a file."""
    return sum(function.stats.cache_hits.values())


def test_second_process_loads_what_the_first_compiled(folder: Path) -> None:
    first, second = compiled(), compiled()
    assert first(2.0) == 6.0
    (file,) = folder.iterdir()
    assert file.stat().st_mode & 0o777 == 0o600
    assert folder.stat().st_mode & 0o777 == 0o700
    assert second(2.0) == 6.0
    assert (hits(first), hits(second)) == (0, 1)


def damaged(content: bytes) -> Iterator[bytes]:
    yield b""
    for share in (31, 32, len(content) // 2):
        yield content[:share]
    yield bytes(len(content))  # blocks that a power failure left unwritten
    yield bytes(k * k % 251 for k in range(1000))
    yield content + b"x"
    at = len(content) // 2  # one wrong bit
    yield content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


def test_damaged_file_is_deleted_and_compiled_again(folder: Path) -> None:
    compiled()(2.0)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    for content in damaged(whole):
        file.write_bytes(content)
        function = compiled()
        assert function(2.0) == 6.0
        assert hits(function) == 0
        assert file.read_bytes()[32:] != content[32:]  # replaced
    again = compiled()
    assert again(2.0) == 6.0
    assert hits(again) == 1
    assert len(list(folder.iterdir())) == 1


def test_file_of_another_function_or_signature_is_not_loaded(folder: Path) -> None:
    compiled()(2.0)
    (of_float,) = folder.iterdir()
    compiled()(2)
    (of_int,) = set(folder.iterdir()) - {of_float}
    of_int.write_bytes(of_float.read_bytes())
    function = compiled()
    assert function(2) == 6
    assert hits(function) == 0


def test_functions_made_for_several_values_have_files_of_their_own(folder: Path) -> None:
    def made_for(size: int) -> Callable[[float], float]:
        @njit(cache=True)
        def added(x: float) -> float:
            return x + size

        return added

    assert (made_for(1)(1.0), made_for(2)(1.0)) == (2.0, 3.0)
    assert len(list(folder.iterdir())) == 2
    again = [made_for(1), made_for(2)]
    assert [function(1.0) for function in again] == [2.0, 3.0]
    assert [hits(function) for function in again] == [1, 1]


def test_python_without_asserts_has_files_of_its_own(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else two processes, one with -O, would compile anew in turn."""
    assert compiled()(2.0) == 6.0
    monkeypatch.setattr(compile_cache, "_OPTIMISED", 2)
    assert compiled()(2.0) == 6.0
    assert len(list(folder.iterdir())) == 2


@pytest.mark.parametrize("mode", [0o620, 0o602, 0o666, 0o660])
def test_file_that_others_may_change_is_not_loaded(folder: Path, mode: int) -> None:
    compiled()(2.0)
    (file,) = folder.iterdir()
    file.chmod(mode)
    function = compiled()
    assert function(2.0) == 6.0
    assert hits(function) == 0
    assert file.stat().st_mode & 0o777 == 0o600


def test_link_is_not_followed(folder: Path, tmp_path: Path) -> None:
    compiled()(2.0)
    (file,) = folder.iterdir()
    elsewhere = tmp_path / "elsewhere"
    file.rename(elsewhere)
    file.symlink_to(elsewhere)
    function = compiled()
    assert function(2.0) == 6.0
    assert hits(function) == 0


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file away")
def test_file_or_folder_of_another_user_is_not_used(folder: Path, tmp_path: Path) -> None:
    compiled()(2.0)
    (file,) = folder.iterdir()
    os.chown(file, 65534, -1)
    function = compiled()
    assert function(2.0) == 6.0
    assert hits(function) == 0
    os.chown(folder, 65534, -1)
    cache_folder.cache_clear()
    other = cache_folder()
    assert other != folder
    assert other is None or other.stat().st_uid == os.getuid()


def test_folder_that_the_group_could_write_is_closed(folder: Path) -> None:
    folder.chmod(0o2770)
    cache_folder.cache_clear()
    assert cache_folder() == folder
    assert folder.stat().st_mode & 0o077 == 0


def test_cache_is_private_whatever_the_umask(tmp_path: Path) -> None:
    code = "import os, sys; os.umask(0); from levid.config.runtime.compile_cache import *; "
    code += "from numba import njit; njit(cache=True)(lambda x: x)(1.0); print(cache_folder())"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "new")},
    )  # fmt: skip
    folder = Path(done.stdout.strip())
    assert folder.stat().st_mode & 0o777 == 0o700


def test_relative_folders_do_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "here")
    monkeypatch.setenv("XDG_CACHE_HOME", "here")
    monkeypatch.setenv("HOME", "here")
    cache_folder.cache_clear()
    found = cache_folder()
    assert found is None or not found.is_relative_to(tmp_path)
    assert not (tmp_path / "here").exists()


def test_without_any_folder_it_compiles_anyway(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("make_private_folder", "is_private_folder"):
        monkeypatch.setattr(compile_cache, name, lambda _: False)
    cache_folder.cache_clear()
    assert cache_folder() is None
    assert compiled()(2.0) == 6.0


def test_full_disk_only_costs_time(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(compile_cache.os, "fdopen", full)
    assert compiled()(2.0) == 6.0
    assert not [path for path in folder.iterdir() if path.suffix != ".tmp"]


def test_other_constant_or_called_function_is_another_source() -> None:
    """numba's own cache overlooks both: a new release would run with old numbers."""

    def stamp_of(text: str) -> str:
        names: dict[str, object] = {"njit": njit}
        exec(compile(text, "/nonexistent.py", "exec"), names)
        return source_stamp(names["f"])

    base = "K = 1\n@njit\ndef g(x):\n    return x + 1\ndef f(x):\n    return K * g(x)\n"
    assert stamp_of(base) == stamp_of(base)
    assert stamp_of(base.replace("K = 1", "K = 2")) != stamp_of(base)
    assert stamp_of(base.replace("x + 1", "x - 1")) != stamp_of(base)
    enum = "from enum import IntEnum\nclass K(IntEnum):\n    A = 1\ndef f(x):\n    return x + K.A\n"
    assert stamp_of(enum.replace("A = 1", "A = 2")) != stamp_of(enum)
