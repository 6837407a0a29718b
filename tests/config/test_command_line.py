"""Test that printed commands are quoted for a shell."""

from __future__ import annotations

import shlex
from pathlib import Path

from levid.config.command_line import command_line, log_words, logs_in, quoted, unused


def test_printed_commands_quote_any_path() -> None:
    odd = Path("my runs") / "it's"
    assert shlex.split(quoted(odd, Path("x"))) == [str(odd), "x"]
    assert shlex.split(logs_in(odd)) == [f"{odd}/*.mcap"]
    assert logs_in(odd).endswith("/*.mcap")  # outside the quotes, so that the shell expands it
    few = [odd / "a.mcap", odd / "b.mcap"]
    assert shlex.split(log_words(few)) == list(map(str, few))
    assert quoted(Path("-x")) == "./-x"  # no option


def test_options_without_a_value_are_left_out() -> None:
    line = command_line("excite", "beam", virtual=True, rig=None, full=False, if_gone="go on")
    assert line == "levid excite beam --virtual --if-gone 'go on'"


def test_many_logs_become_a_pattern_only_if_they_are_all_logs_of_the_folder(tmp_path: Path) -> None:
    paths = []
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        paths += [tmp_path / day / f"{k}.mcap" for k in range(3)]
    for path in paths:
        path.write_bytes(b"")
    monday, tuesday = (logs_in(tmp_path / day) for day in ("monday", "tuesday"))
    assert log_words(paths) == f"{monday} {tuesday}"
    assert log_words(paths[:5]) == f"{monday} {quoted(*paths[3:5])}"


def test_an_unused_folder_is_numbered(tmp_path: Path) -> None:
    assert unused(tmp_path / "beam") == tmp_path / "beam"
    (tmp_path / "beam").mkdir()
    (tmp_path / "beam-2").mkdir()
    assert unused(tmp_path / "beam") == tmp_path / "beam-3"
