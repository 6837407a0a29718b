"""Links that others planted in a shared folder lead no command to another file.

Each command runs twice. The first run, in a clean folder, tells which names it opens for writing,
temporary names included. For the second run all these names are links to a file that must stay.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from levid.config.shipped import shipped
from levid.log.importing.importer import import_file

_OTHER = 65534
_PRECIOUS = "root's file\n"
_SIGNALS = """
levid: signals
rate_hz: 250
columns:
  - {column: 0, name: f_n, unit: N, role: input}
  - {column: 1, name: x_m, unit: m, role: output}
"""
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
_COMMANDS = {
    "layout": ("layout", "RIG", "--out", "OUT"),
    "new signals": ("new", "signals", "DATA/a.csv", "-o", "OUT/a.yaml"),
    "import": ("import", "DATA/a.csv", "--signals", "DATA/signals.yaml", "-o", "OUT/a.mcap"),
    "export csv": ("export", "DATA/a.mcap", "--overwrite", "-o", "OUT/a.csv"),
    "export npz": ("export", "DATA/a.mcap", "--overwrite", "-o", "OUT/a.npz"),
    "export mat": ("export", "DATA/a.mcap", "--overwrite", "-o", "OUT/a.mat"),
    "export folder": ("export", "DATA/a.mcap", "--format", "csv", "-o", "OUT/tables"),
    "plot svg": ("plot", "DATA/a.mcap", "-o", "OUT/a.svg"),
    "plot png": ("plot", "DATA/a.mcap", "-o", "OUT/a.png"),
    "salvage": ("salvage", "DATA/cut.mcap", "--out", "OUT"),
    "identify": ("identify", "DATA/a.mcap", "--order", "2", "--impulse-s", "0.2", "--out", "OUT"),
    "excite": ("excite", "SESSION", "--rig", "RIG", "--virtual", "--out", "OUT"),
    "install-service": ("install-service", "RIG", "--root", "OUT", "--force"),
    "list": ("list", "OUT", "--parquet"),
}
_SESSION = """
levid: session
name: short
steps:
  - levitate: {settle_s: 0.5}
  - {record: {name: still, duration_s: 1.2}}
  - land: {}
"""

_opened: list[str] | None = None


def _hook(event: str, args: tuple[object, ...]) -> None:
    if _opened is not None and event == "open" and isinstance(args[0], str):
        flags = args[2] if isinstance(args[2], int) else 0
        if flags & _WRITING:
            _opened.append(args[0])


sys.addaudithook(_hook)


@contextmanager
def _names_opened_for_writing() -> Iterator[list[str]]:
    global _opened  # noqa: PLW0603 - an audit hook cannot be removed
    _opened = found = []
    try:
        yield found
    finally:
        _opened = None


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log, one that is cut off, a session, and data to import."""
    folder = tmp_path_factory.mktemp("data")
    rng = np.random.default_rng(1)
    force = rng.standard_normal(1000)
    position = np.convolve(force, 0.9 ** np.arange(40) * np.sin(np.arange(40) / 4))[:1000]
    table = np.column_stack([force, position + 1e-3 * rng.standard_normal(1000)])
    np.savetxt(folder / "a.csv", table, delimiter=",", fmt="%.9g")
    (folder / "signals.yaml").write_text(_SIGNALS)
    (folder / "short.yaml").write_text(_SESSION)
    import_file(folder / "a.csv", folder / "signals.yaml", folder / "a.mcap")
    whole = bytearray((folder / "a.mcap").read_bytes())
    whole[-200:-100] = bytes(100)
    (folder / "cut.mcap").write_bytes(whole)
    return folder


def _arguments(command: tuple[str, ...], data: Path, out: Path) -> list[str]:
    places = {
        "RIG": str(shipped("rigs/loopback.yaml")),
        "SESSION": str(data / "short.yaml"),
        "DATA": str(data),
        "OUT": str(out),
    }
    return [
        "/".join(places.get(part, part) for part in word.split("/")) if word else word
        for word in command
    ]


def _plant(link: Path, target: Path) -> None:
    """Make a link as another user would, as far as this user can."""
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(target)
    if os.geteuid() == 0:
        os.chown(link, _OTHER, _OTHER, follow_symlinks=False)


@pytest.mark.parametrize("name", _COMMANDS)
def test_no_command_writes_through_a_planted_link(
    name: str,
    data: Path,
    tmp_path: Path,
    run_levid: Callable[..., int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "clean"
    command = _COMMANDS[name]
    _prepare(name, data, out)
    with _names_opened_for_writing() as opened:
        assert run_levid(*_arguments(command, data, out)) == 0
    files = {p.relative_to(out) for p in out.rglob("*") if not p.is_dir()}
    files |= {Path(p).relative_to(out) for p in opened if Path(p).is_relative_to(out)}
    files |= {Path(p) for p in opened if not Path(p).is_absolute() and p != "."}
    _links_to_a_file(name, data, tmp_path, files, run_levid)
    if os.geteuid() == 0:
        folders = {p.relative_to(out) for p in out.rglob("*") if p.is_dir()}
        _links_to_a_folder(name, data, tmp_path, folders, run_levid)
    assert "Traceback" not in capsys.readouterr().err


def _prepare(name: str, data: Path, out: Path) -> None:
    """Make the folder of a command; `list` needs a flight in it."""
    out.mkdir(parents=True)
    if name == "list":
        (out / "flight").mkdir()
        (out / "flight" / "a.mcap").write_bytes((data / "a.mcap").read_bytes())


def _links_to_a_file(
    name: str, data: Path, tmp_path: Path, files: set[Path], run_levid: Callable[..., int]
) -> None:
    shared, precious = tmp_path / "shared", tmp_path / "precious"
    _prepare(name, data, shared)
    precious.write_text(_PRECIOUS)
    before = precious.stat()
    planted = [path for path in files if not (shared / path).exists()]
    assert planted
    for path in planted:
        _plant(shared / path, precious)
    run_levid(*_arguments(_COMMANDS[name], data, shared))  # it may refuse
    after = precious.stat()
    assert precious.read_text() == _PRECIOUS
    assert (after.st_mode, after.st_mtime_ns) == (before.st_mode, before.st_mtime_ns)


def _links_to_a_folder(
    name: str, data: Path, tmp_path: Path, folders: set[Path], run_levid: Callable[..., int]
) -> None:
    """Only root can make links of another user."""
    for number, folder in enumerate(sorted(folders - {Path("flight")} or {Path()})):
        victim, shared = tmp_path / "victims" / str(number), tmp_path / str(number)
        _prepare(name, data, victim)
        before = sorted(victim.rglob("*"))
        _plant(shared / folder, victim)
        assert run_levid(*_arguments(_COMMANDS[name], data, shared)) == 1
        assert sorted(victim.rglob("*")) == before, folder
