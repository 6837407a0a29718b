"""What is no file makes no reader wait, and JSON and YAML have limits wherever they are read."""

from __future__ import annotations

import ast
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import levid
from levid.config.base import MOST_DEPTH
from levid.config.files.reading import (
    MOST_LEVELS,
    JsonError,
    kind_of,
    open_file,
    parse_json,
    read_json,
)
from levid.config.shipped import shipped
from levid.log.log_facts import rig_name, versions

_ROOT = Path(levid.__file__).parent


def _pipe(path: Path) -> str:
    os.mkfifo(path)
    return "a pipe"


def _socket(path: Path) -> str:
    with socket.socket(socket.AF_UNIX) as end:
        end.bind(str(path))
    return "a socket"


def _folder(path: Path) -> str:
    path.mkdir()
    return "a folder"


def _device(path: Path) -> str:
    path.symlink_to("/dev/zero")
    return "a device"


KINDS = [_pipe, _socket, _folder, _device]


@pytest.mark.parametrize("make", KINDS)
def test_only_a_file_is_opened(make: Callable[[Path], str], tmp_path: Path) -> None:
    path = tmp_path / "a"
    found = make(path)
    assert kind_of(path) == found
    with pytest.raises(OSError, match=f"expected a file, found {found}"):
        open_file(path)


@pytest.mark.parametrize("make", KINDS)
@pytest.mark.parametrize(
    "command",
    [
        "import PATH.csv --signals {signals} -o {out}/a.mcap",
        "import {data} --signals PATH.yaml -o {out}/a.mcap",
        "new signals PATH.npz -o {out}/a.yaml",
        "new signals PATH.mat -o {out}/a.yaml",
        "check PATH.yaml",
        "check PATH.mcap",
        "info PATH.mcap",
        "plot PATH.mcap -o {out}/a.svg",
        "export PATH.mcap -o {out}/a.csv",
        "salvage PATH.mcap",
        "identify PATH.mcap --out {out}",
        "trace PATH.mcap --out {out}",
    ],
)
def test_commands_name_what_stands_in_place_of_a_file(
    command: str,
    make: Callable[[Path], str],
    tmp_path: Path,
    levid: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("levid.config.base.PIPE_WAIT_S", 0.05)
    signals, data = tmp_path / "signals.yaml", tmp_path / "data.csv"
    signals.write_text(shipped("signals/emps.yaml").read_text())
    data.write_text("a,b\n1,2\n")
    words = command.format(signals=signals, data=data, out=tmp_path).split()
    place = next(word for word in words if word.startswith("PATH"))
    path = tmp_path / f"other{place[4:]}"
    kind = make(path)
    code, out, err = levid(*[path if word == place else word for word in words])
    assert code == 1
    said = out + err
    assert str(path) in said
    if command.startswith("info") and kind == "a folder":
        return  # it describes folders
    known = (kind, "expected a file, or a pipe that ends", "an empty file", "KiB, found more")
    assert any(text in said for text in known), said
    assert kind == "a folder" or "folder" not in said


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 10**6, "levels"),
        ("[" * (MOST_LEVELS + 1) + "]" * (MOST_LEVELS + 1), "levels"),
        ('{"a":' * 200 + "1" + "}" * 200, "levels"),
        ("[NaN]", "finite numbers or null, found NaN"),
        ("[-Infinity]", "found -Infinity"),
        ("[1e999]", "finite numbers, found 1e999"),
        ("1" * 5000, "numbers of some digits"),
        ("{", "line 1, column 2"),
        (b"\xff", "UTF-8"),
        ("[" + "1," * 600 + "1]", "at most 1000 bytes"),
    ],
)
def test_json_beyond_a_limit_is_an_error_in_words(text: str | bytes, words: str) -> None:
    with pytest.raises(JsonError, match=words):
        parse_json(text, 10**7 if "bytes" not in words else 1000)


def test_json_within_the_limits_is_read(tmp_path: Path) -> None:
    text = "[" * MOST_LEVELS + "]" * MOST_LEVELS
    assert parse_json(text) is not None
    (tmp_path / "a.json").write_text('{"a": [1, 2.5e3, null]}')
    assert read_json(tmp_path / "a.json") == {"a": [1, 2500.0, None]}


@pytest.mark.parametrize(
    "text",
    [
        "name: a\nx: " + "[" * (MOST_DEPTH + 1) + "]" * (MOST_DEPTH + 1),
        "name: a\nx: " + "[" * 10**5,
        "name: a\na: &a [1, 2]\n" + "".join(f"b{i}: &b{i} [*a, *a]\n" for i in range(10**4)),
        "name: a\nx: " + "y" * (1 << 19),
        "a: &a [*a]\nname: b",
        "name: !!python/object/apply:os.getcwd []",
    ],
)
def test_yaml_in_a_log_has_the_limits_of_a_file(text: str) -> None:
    assert rig_name({"rig.yaml": text.encode()}) == ""


def test_versions_in_a_log_have_the_limits_of_json() -> None:
    assert versions({"versions.json": b"[" * 10**6}) == {}
    assert versions({"versions.json": b'{"levid": "1"}'}) == {"levid": "1"}


_OTHER_READERS = {
    # The one YAML loader.
    ("config/base.py", "yaml.load"),
    # The one JSON loader.
    ("config/files/reading.py", "json.loads"),
    # Lines between the daemon and its own processes and clients, which have limits of their own.
    ("daemon/client.py", "json.loads"),
    ("daemon/api/control_server.py", "json.loads"),
    ("daemon/host/real_time_rights.py", "json.loads"),
    ("daemon/live/control_link.py", "json.loads"),
    ("daemon/live/live_process.py", "json.loads"),
    ("daemon/live/page_server.py", "json.loads"),
    ("daemon/planning/planner.py", "json.loads"),
    ("daemon/recording/recorder_link.py", "json.loads"),
    ("daemon/recording/recorder_process.py", "json.loads"),
    # The answer of the child process that reads MAT files.
    ("log/importing/mat_file_reader.py", "json.loads"),
}


def test_one_loader_reads_all_yaml_and_one_all_json() -> None:
    names = {"load", "load_all", "safe_load", "safe_load_all", "full_load", "loads"}
    found = set()
    for path in sorted(_ROOT.rglob("*.py")):
        file = path.relative_to(_ROOT).as_posix()
        if file.startswith(("tests/", "benchmarks/", "docs/", "build/", ".venv/")):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = ast.unparse(node) if isinstance(node, ast.Attribute) else ""
            if name.partition(".")[0] in ("yaml", "json") and name.partition(".")[2] in names:
                found.add((file, name))
    assert found == _OTHER_READERS
