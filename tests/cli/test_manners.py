"""Test manners of the command line: suggestions, sections of help, colours and progress bars."""

from __future__ import annotations

import errno
import os
import pty
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from levid.cli.command_group import unknown_command
from levid.cli.main import _SECTIONS, _VERBS, _words

LONG = """
levid: session
name: long
excitations:
  psi: {input: psi, rms_n_m: 0.05}
steps:
  - levitate: {}
  - record: {name: an-hour, duration_s: 3600, excite: [psi]}
  - land: {}
"""


@pytest.mark.parametrize(
    ("arguments", "suggestion"),
    [
        (["identfy"], "unknown command 'identfy'; did you mean 'identify'?"),
        (["IDENTIFY"], "did you mean 'identify'?"),
        (["com"], "did you mean 'commission', 'compare' or 'completion'?"),
        (["xyzzy"], "unknown command 'xyzzy'; `levid --help` lists all commands"),
        (["new", "sinals"], "unknown command 'sinals'; did you mean 'signals'?"),
        (["new", "xyzzy"], "`levid new --help` lists all commands"),
        (["excite", "a.yaml", "--virual", "--out", "b"], "'--virtual'"),
    ],
)
def test_misspelt_command_or_option_is_suggested(
    levid, arguments: list[str], suggestion: str
) -> None:
    outcome = levid(*arguments)
    assert outcome.code == 2
    assert suggestion in outcome.err
    assert outcome.out == ""


def test_few_commands_are_suggested() -> None:
    known = [f"run-{n}" for n in range(9)]
    assert unknown_command("run", known, "levid").count("run-") == 3


def test_every_command_is_in_one_section_of_the_help(levid) -> None:
    listed = [verb for verbs in _SECTIONS.values() for verb in verbs]
    assert sorted(listed) == sorted(_VERBS)
    out = levid("--help").out
    for title, verbs in _SECTIONS.items():
        assert re.search(rf"^{title}:\n  {verbs[0]} ", out, re.M)
    assert "Other commands" not in out


@pytest.mark.parametrize("verb", _VERBS)
def test_help_of_every_command_has_examples_of_it(levid, verb: str) -> None:
    outcome = levid(verb, "--help")
    assert outcome.code == 0
    examples = outcome.out.partition("Examples:\n")[2].partition("\n\n")[0]
    assert re.search(rf"^\s+(sudo )?levid {verb}", examples, re.M)


def test_levid_alone_prints_the_help(levid) -> None:
    assert "Examples:" in levid().err


def in_a_terminal(*arguments: object, **environment: str) -> str:
    """Return what a command writes to a terminal."""
    root = Path(sys.modules["levid"].__path__[0]).parent
    unset = {"NO_COLOR", "FORCE_COLOR", "COLORTERM"}
    own: Mapping[str, str] = {
        **{key: value for key, value in os.environ.items() if key not in unset},
        **{"PYTHONPATH": str(root), "TERM": "xterm-256color", "COLUMNS": "100", **environment},
    }
    child, terminal = pty.fork()
    if child == 0:
        command = [sys.executable, "-m", "levid.cli.main", *map(str, arguments)]
        os.execve(sys.executable, command, dict(own))
    written = b""
    while True:
        try:
            data = os.read(terminal, 1 << 16)
        except OSError:  # the command has ended
            break
        written += data
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0, written
    return written.decode()


COLOUR_OR_BOLD = re.compile(r"\x1b\[[0-9;]*m")


def test_check_of_a_long_session_shows_its_progress(tmp_path: Path) -> None:
    path = tmp_path / "long.yaml"
    path.write_text(LONG)
    written = in_a_terminal("check", path)
    assert "checking long.yaml" in written
    assert "an-hour" in written
    assert COLOUR_OR_BOLD.search(written)
    assert f"{path}: session, 3 steps" in written


def test_no_color_is_respected_and_a_dumb_terminal_gets_no_bar(tmp_path: Path) -> None:
    path = tmp_path / "long.yaml"
    path.write_text(LONG)
    written = in_a_terminal("check", path, NO_COLOR="1")
    assert "checking long.yaml" in written
    assert not COLOUR_OR_BOLD.search(written)
    written = in_a_terminal("check", path, TERM="dumb")
    assert "\x1b" not in written
    assert "checking" not in written


def test_nothing_but_text_is_written_to_a_file_or_a_pipe(levid, tmp_path: Path) -> None:
    path = tmp_path / "long.yaml"
    path.write_text(LONG)
    outcome = levid("check", path)
    assert outcome.out.startswith(f"{path}: session, 3 steps")
    assert outcome.err == ""


def test_no_command_writes_an_escape_code_into_its_help(levid) -> None:
    assert all("\x1b" not in levid(verb, "--help").out for verb in ("run", "new", "check"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["move", "--beam-m", "far"], "'--beam-m': 'far' is not a number."),
        (["watch", "--every-s", "0"], "0.0 is not between 0.05 and 3600."),
        (["watch", "--every-s", "?"], "'?' is not a number."),
        (["identify", "a", "--out", "b", "--order", "?"], "'?' is not a whole number."),
        (["identify", "a", "--out", "b", "--impulse-s", "0"], "0.0 is not greater than 0.0."),
        (["trace", "a", "--out", "b", "--workers", "0"], "0 is not at least 1."),
    ],
)
def test_wrong_number_is_reported_in_words(levid, arguments: list[str], words: str) -> None:
    outcome = levid(*arguments)
    assert outcome.code == 2
    assert words in outcome.err


@pytest.mark.parametrize("verb", _VERBS)
def test_no_name_of_a_type_is_in_a_help(levid, verb: str) -> None:
    assert not re.search(r"\b(FLOAT|INTEGER|PATH|RANGE|TEXT)\b", levid(verb, "--help").out)


def test_error_of_the_operating_system_names_file_and_remedy() -> None:
    full = OSError(errno.ENOSPC, "No space left on device", "out/model.yaml")
    assert _words(full) == (
        "out/model.yaml: No space left on device: remove files, or write to another disk"
    )
    assert _words(OSError(errno.ENOENT, "No such file or directory", "a")) == (
        "a: No such file or directory"
    )


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a small disk")
def test_full_disk_is_reported_with_its_file_and_a_remedy(levid, tmp_path: Path) -> None:
    disk, session = tmp_path / "disk", tmp_path / "session.yaml"
    disk.mkdir()
    session.write_text(LONG.replace("3600", "20"))
    mount = ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", disk]
    if subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("this machine mounts no disk")
    try:
        outcome = levid("excite", session, "--virtual", "--out", disk / "out")
    finally:
        subprocess.run(["umount", disk], check=True)
    assert outcome.code == 1
    assert re.search(r"mcap: cannot be written: No space left on device: remove files", outcome.err)


@pytest.mark.parametrize("verb", ["identify", "trace", "check"])
def test_file_that_is_no_log_is_reported_without_its_bytes(levid, tmp_path: Path, verb) -> None:
    path = tmp_path / "data.mcap"
    path.write_text("time,position\n0,1\n")
    out = [] if verb == "check" else ["--out", tmp_path / "out"]
    outcome = levid(verb, path, *out)
    assert outcome.code == 1
    assert "expected an MCAP log, found another kind of file; `levid import`" in outcome.err
