"""No product file opens a file for writing, makes a folder or a link but through config/files."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import levid

_ROOT = Path(levid.__file__).parent
_PACKAGES = (
    *("api", "cli", "config", "daemon", "drivers", "identification", "log", "model", "report"),
    *("sim", "wire"),
)
_WRITER = ("config/files/atomic_write.py", "config/files/folders.py")
_ALLOWED = {
    # No path of a user: the kernel's own files, memory, and names that the kernel makes unique.
    ("daemon/host/process_confinement.py", "write_text"): "/proc/self/oom_score_adj",
    ("daemon/host/real_time_scheduling.py", "os.open"): "/dev/cpu_dma_latency",
    ("daemon/host/child_process.py", "open"): "a memory file",
    ("api/data_import.py", "mkdir"): "in a temporary folder that this process just made",
    ("daemon/api/unix_listener.py", "chmod"): "by its descriptor, of a socket alone",
    # The cache of executed code and the locks of buses have rules of their own, see their files.
    ("config/runtime/private_files.py", "mkdir"): "a folder of this user alone, checked after",
    ("config/runtime/private_files.py", "chmod"): "of a folder of this user",
    ("drivers/bus_lock.py", "os.open"): "a folder of the rig's users, O_EXCL and O_NOFOLLOW",
    ("drivers/bus_lock.py", "mkdir"): "a folder of the service's state",
    ("drivers/bus_lock.py", "chmod"): "of the folder just made",
    # numpy writes to a file object that is a pipe.
    ("log/importing/mat_file_reader.py", "save"): "a pipe to the parent process",
}
_METHODS = {
    *("write_text", "write_bytes", "touch", "mkdir", "symlink_to", "hardlink_to", "rename"),
    *("to_parquet", "to_csv", "to_netcdf", "to_hdf", "to_pickle", "tofile", "savetxt"),
    *("savez", "savez_compressed", "memmap", "chmod", "lchmod", "mkfifo", "makedirs"),
    *("copyfile", "copy2", "copytree", "mknod", "truncate"),
}
_FUNCTIONS = {"np.save", "numpy.save", "shutil.move", "shutil.copy"}
_OS = {"rename", "replace", "link", "symlink", "mkdir", "makedirs", "mkfifo", "mknod", "chmod"}
_TAKE_A_FILE = {"savemat", "savefig", "ParquetWriter", "write_table", "ZipFile"}
"""They also take a path, which they would open by themselves: the first argument has to be a file
object, which is named `file`, `buffer` or as a keyword's value in memory."""
_FILE_OBJECTS = {"file", "buffer", "page", "text"}


def _name(node: ast.expr) -> str:
    """Return the dotted name of a call, as far as it is one."""
    if isinstance(node, ast.Attribute):
        inner = _name(node.value)
        return f"{inner}.{node.attr}" if inner else node.attr
    return node.id if isinstance(node, ast.Name) else ""


def _mode(call: ast.Call, place: int) -> str:
    """Return the mode of an open(), "?" if it is not a literal."""
    given = [k.value for k in call.keywords if k.arg == "mode"]
    given += call.args[place : place + 1]
    if not given:
        return "r"
    return str(given[0].value) if isinstance(given[0], ast.Constant) else "?"


def _writes(call: ast.Call) -> str | None:  # noqa: PLR0911 - a table of cases
    """Return by what a call writes a file or makes a folder or link, None if it does not."""
    name = _name(call.func)
    last = name.rpartition(".")[2]
    if name == "open" or (last == "open" and name not in ("os.open", "webbrowser.open")):
        mode = _mode(call, 1 if name in ("open", "io.open", "gzip.open", "archive.open") else 0)
        opens_a_member = name.startswith("archive.")
        return "open" if set(mode) & set("wxa+") and not opens_a_member else None
    if name == "os.open":
        flags = ast.unparse(call)
        return name if any(f in flags for f in ("O_WRONLY", "O_RDWR", "O_CREAT")) else None
    if name.startswith("os.") and last in _OS:
        return last
    if last in _TAKE_A_FILE:
        first = call.args[0] if call.args else None
        first = (
            first.args[1] if isinstance(first, ast.Call) and _name(first.func) == "cast" else first
        )
        if last == "write_table":
            first = call.args[1] if len(call.args) > 1 else None
            if name.startswith("writer."):
                return None
        if last == "ZipFile" and _mode(call, 1) == "r":
            return None
        return None if isinstance(first, ast.Name) and first.id in _FILE_OBJECTS else last
    if name in _FUNCTIONS or (last in _METHODS and isinstance(call.func, ast.Attribute)):
        return last
    return None


def _findings() -> Iterator[tuple[str, int, str]]:
    for package in _PACKAGES:
        for path in sorted((_ROOT / package).rglob("*.py")):
            file = path.relative_to(_ROOT).as_posix()
            if file in _WRITER:
                continue
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and (found := _writes(node)):
                    yield file, node.lineno, found


def test_every_file_is_written_through_the_writer() -> None:
    wrong = [
        f"{file}:{line}: {what}" for file, line, what in _findings() if (file, what) not in _ALLOWED
    ]
    assert not wrong, "use config.files.atomic_write or config.files.folders:\n" + "\n".join(wrong)


def test_every_exception_is_needed() -> None:
    found = {(file, what) for file, _, what in _findings()}
    assert set(_ALLOWED) <= found
