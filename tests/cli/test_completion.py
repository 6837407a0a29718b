"""Test the completion of commands, options and files in real shells, and by what they ask levid."""

from __future__ import annotations

import os
import pty
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from levid.config.shipped import shipped

ROOT = Path(sys.modules["levid"].__path__[0]).parent
SHELLS = ("bash", "zsh", "fish")
_PATIENCE_S = 60.0


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with files of every kind, and a command `levid` in bin."""
    files = {
        "my rig.yaml": shipped("rigs/loopback.yaml").read_text(),
        "flight.yaml": shipped("sessions/beam.yaml").read_text(),
        "plant.yaml": shipped("models/rig.yaml").read_text(),
        "notes.yaml": "author: me\n",
        "a.mcap": "",
        "data.csv": "",
        "readme.txt": "",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "b.mcap").touch()
    (tmp_path / "bin").mkdir()
    command = tmp_path / "bin" / "levid"
    command.write_text(
        f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m levid.cli.main "$@"\n'
    )
    command.chmod(0o755)
    return tmp_path


def answer(folder: Path, words: Sequence[str], shell: str = "bash") -> list[str]:
    """Return what levid tells a shell for a line of which the last word is incomplete."""
    line = {"COMP_WORDS": " ".join(words), "COMP_CWORD": str(len(words) - 1)}
    if shell == "fish":
        line["COMP_CWORD"] = words[-1]
    done = subprocess.run(
        [folder / "bin" / "levid"],
        env={**os.environ, **line, "_LEVID_COMPLETE": f"{shell}_complete"},
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.splitlines()


def values(folder: Path, *words: str) -> list[str]:
    return [line.partition(",")[2] for line in answer(folder, ["levid", *words])]


def test_commands_and_options(folder: Path) -> None:
    assert values(folder, "ident") == ["identify"]
    assert values(folder, "new", "s") == ["session", "signals", "sim"]
    assert values(folder, "new", "rig", "c") == ["can", "canfd"]
    assert values(folder, "excite", "--vi") == ["--virtual"]
    assert values(folder, "completion", "") == list(SHELLS)
    assert values(folder, "identify", "--markov", "") == ["least_squares", "correlation"]


@pytest.mark.parametrize(
    ("words", "files"),
    [
        (("run", ""), ["my rig.yaml", "notes.yaml"]),
        (("excite", ""), ["flight.yaml", "notes.yaml"]),
        (("excite", "flight.yaml", "--rig", ""), ["my rig.yaml", "notes.yaml"]),
        (("identify", ""), ["a.mcap"]),
        (("identify", "a.mcap", "--model", ""), ["notes.yaml", "plant.yaml"]),
        (("import", ""), ["data.csv", "readme.txt"]),
        (("check", ""), ["a.mcap", "flight.yaml", "my rig.yaml", "notes.yaml", "plant.yaml"]),
        (("trace", "a.mcap", "--out", ""), []),
        (("identify", "sub/"), ["sub/b.mcap"]),
    ],
)
def test_files_are_offered_by_kind(folder: Path, words: list[str], files: list[str]) -> None:
    """A YAML file without the key `levid` may be of any kind."""
    lines = answer(folder, ["levid", *words])
    found = [line.partition(",")[2] for line in lines if line.startswith("path,")]
    assert [name for name in found if not name.endswith("/")] == files
    if words[-1] == "":
        assert [name for name in found if name.endswith("/")] == ["bin/", "sub/"]


def test_shipped_names_are_offered_by_kind(folder: Path) -> None:
    assert values(folder, "run", "can") == ["can", "canfd"]
    assert values(folder, "excite", "be") == ["beam"]
    assert values(folder, "excite", "beam", "--sim", "u") == ["undeclared"]
    assert values(folder, "check", "lo") == ["loopback"]


def test_zsh_and_fish_get_summaries(folder: Path) -> None:
    assert answer(folder, ["levid", "land"], "zsh") == [
        *("plain", "land", "End the running session and land.")
    ]
    assert answer(folder, ["levid", "land"], "fish") == [
        "plain,land\tEnd the running session and land."
    ]


@pytest.mark.parametrize("shell", SHELLS)
def test_script_says_how_to_install_it(levid, shell: str) -> None:
    outcome = levid("completion", shell)
    assert outcome.code == 0
    assert any(
        line.startswith("# To install: ") and f"levid completion {shell}" in line
        for line in outcome.out.splitlines()[:2]
    )
    if shell == "zsh":  # which completes with files whose first line is this
        assert outcome.out.startswith("#compdef levid\n")
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=outcome.out, text=True, check=True)


def test_other_shell_is_refused(levid) -> None:
    assert levid("completion", "csh").code == 2


def test_completion_imports_no_heavy_module(folder: Path) -> None:
    """Each press of the Tab key waits for it."""
    program = (
        "import sys\n"
        "from levid.cli.main import main\n"
        "try:\n    main()\n"
        "except SystemExit:\n    pass\n"
        "heavy = {'numpy', 'scipy', 'pydantic', 'yaml', 'rich', 'can', 'matplotlib'}\n"
        "print(sorted(heavy & set(sys.modules)), file=sys.stderr)\n"
    )
    asked = {"COMP_WORDS": "levid excite ", "COMP_CWORD": "2", "_LEVID_COMPLETE": "bash_complete"}
    for arguments, more in ((["completion", "bash"], {}), ([], asked)):
        done = subprocess.run(
            [sys.executable, "-c", program, *arguments],
            env={**os.environ, "PYTHONPATH": str(ROOT), **more},
            cwd=folder,
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout
        assert done.stderr.strip() == "[]"


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
@pytest.mark.parametrize(
    "steps",
    [
        (("levid ident", "levid identify "),),
        (("levid run m", "levid run my\\ rig.yaml "),),
        (("levid excite --vi", "levid excite --virtual "),),
        (("levid identify su", "levid identify sub/"), ("b", "levid identify sub/b.mcap ")),
    ],
)
def test_tab_key_in_bash(folder: Path, steps: tuple[tuple[str, str], ...]) -> None:
    """Type each text and the Tab key, and wait until the line is as expected."""
    start = folder / "bashrc"
    start.write_text("PS1='> '\nbind 'set bell-style none'\nsource <(levid completion bash)\n")
    child, terminal = pty.fork()
    if child == 0:
        os.chdir(folder)
        path = f"{folder / 'bin'}:{os.environ['PATH']}"
        own = {**os.environ, "PATH": path, "TERM": "dumb", "INPUTRC": "/dev/null"}
        os.execvpe("bash", ["bash", "--noprofile", "--rcfile", str(start), "-i"], own)
    try:
        read_until(terminal, "> ")
        shown = ""
        for typed, line in steps:
            os.write(terminal, f"{typed}\t".encode())
            shown = read_until(terminal, line, shown)
    finally:
        os.close(terminal)
        os.waitpid(child, 0)


def read_until(terminal: int, text: str, shown: str = "") -> str:
    """Return `shown` and what the terminal writes after it, up to the first text in it."""
    until_s = time.monotonic() + _PATIENCE_S
    while text not in shown:
        ready, _, _ = select.select([terminal], [], [], max(until_s - time.monotonic(), 0.0))
        assert ready, shown
        shown += os.read(terminal, 1 << 16).decode().replace("\r", "")
    return shown
