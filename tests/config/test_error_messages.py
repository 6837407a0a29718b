"""Test error messages of configuration files: file, key, what is expected, what is found."""

from __future__ import annotations

import difflib
import gc
import os
import re
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from levid.config.base import (
    MOST_BYTES,
    MOST_DEPTH,
    MOST_DIGITS,
    MOST_KEY,
    MOST_NODES,
    ConfigError,
    Strict,
    load_yaml,
    parse,
    parse_text,
    read_mapping,
)
from levid.config.error_messages import _FORMS, MOST_MISTAKES
from levid.config.load_any_kind import KINDS, load_any
from levid.config.model import ModelConfig
from levid.config.rig import RigConfig, load_rig
from levid.config.session import Move, SessionConfig, load_session
from levid.config.shipped import shipped
from levid.log.importing.signals_yaml import SignalsFile

CONFIG = Path(shipped("rigs/loopback.yaml")).parent.parent


SESSION = "levid: session\nname: a\nsteps: [{levitate: {}}, {land: {}}]\n"


def rig_text(**changes: object) -> str:
    data = yaml.safe_load(shipped("rigs/loopback.yaml").read_text())
    for dotted, value in changes.items():
        *path, last = dotted.split("__")
        inner = data
        for key in path:
            inner = inner[key]
        inner[last] = value
    return yaml.safe_dump(data)


def error_of(tmp_path: Path, text: str) -> str:
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_rig(path)
    assert str(path) in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    "path", sorted(CONFIG.glob("*/*.yaml")), ids=lambda p: f"{p.parent.name}/{p.name}"
)
def test_every_shipped_file_is_read(path: Path) -> None:
    if path.parent.name == "signals":
        pytest.skip("read by the importer's own tests")
    assert load_any(path)


def test_unknown_key_suggests_the_most_similar_key(tmp_path: Path) -> None:
    assert "limits.coil_nn: unknown key; expected 'coil_n'" in error_of(
        tmp_path, rig_text(limits__coil_nn=20)
    )


def test_key_with_wrong_unit_suggests_the_right_one(tmp_path: Path) -> None:
    message = error_of(tmp_path, rig_text(limits__gap_mm=0.85))
    assert "limits.gap_mm" in message
    assert "'gap_m'" in message


def test_value_out_of_range_reports_bound_and_value(tmp_path: Path) -> None:
    message = error_of(tmp_path, rig_text(limits__coil_n=-20))
    assert "limits.coil_n: expected a number greater than 0, found -20" in message


def test_text_where_a_number_belongs(tmp_path: Path) -> None:
    message = error_of(tmp_path, rig_text(rate_hz="1 kHz"))
    assert "rate_hz: expected a number, found '1 kHz'" in message


def test_loop_timeout_below_three_periods_is_rejected(tmp_path: Path) -> None:
    message = error_of(tmp_path, rig_text(rate_hz=10, service={"loop_s": 0.299}))
    assert "service.loop_s: expected at least 0.3 s" in message
    path = tmp_path / "rig.yaml"
    model = str(shipped("models/rig.yaml"))
    path.write_text(rig_text(rate_hz=10, service={"loop_s": 0.3}, model=model))
    assert load_rig(path).service.loop_s == 0.3


def test_missing_key(tmp_path: Path) -> None:
    data = yaml.safe_load(rig_text())
    del data["control"]["z"]
    assert "control.z: required key is missing" in error_of(tmp_path, yaml.safe_dump(data))


def test_invalid_yaml_reports_line_and_column(tmp_path: Path) -> None:
    message = error_of(tmp_path, "levid: rig\nname: [unclosed\n")
    assert "rig.yaml:3:1: not valid YAML: expected ',' or ']', found the end of the file" in message


@pytest.mark.parametrize(
    "text", ["a: b: c", "a:\n\tb: 1", "a: 'x", "a: 1\n - b", "a: 1\nb", "a: }"]
)
def test_yaml_errors_contain_no_terms_of_the_parser(text: str) -> None:
    message = message_of(lambda: parse_text(text, SessionConfig, "s"))
    assert not re.search("<|token|node|scan|stream|mapping values", message)


def test_duplicate_key(tmp_path: Path) -> None:
    assert "duplicate key 'name'" in error_of(tmp_path, "levid: rig\nname: a\nname: b\n")


@pytest.mark.parametrize("text", ["", "- a\n- b\n", "just text", "\x00\x01", "a: &x [*x]\n"])
def test_file_without_top_level_keys_is_an_error(tmp_path: Path, text: str) -> None:
    error_of(tmp_path, text)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load_rig(tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match="expected a file, found a folder"):
        load_rig(tmp_path)


def test_unknown_kind_of_file_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text("levid: rocket\n")
    with pytest.raises(ConfigError, match=r"expected one of .*rig.*found 'rocket'"):
        load_any(path)


def test_numbers_like_1e_4_are_numbers(tmp_path: Path) -> None:
    text = shipped("models/rig.yaml").read_text().replace("value: 0.0003", "value: 3e-4")
    path = tmp_path / "model.yaml"
    path.write_text(text)
    assert load_yaml(path, ModelConfig).parameters["lag"].value == 3e-4


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        ("often", "an integer or 'auto', found 'often'"),
        (0.5, "an integer or 'auto', found 0.5"),
        (-5, "a number of at least 0 or 'auto', found -5"),
        ([0, 1], "an integer or 'auto', found [0, 1]"),
    ],
)
def test_key_that_accepts_several_types_gives_one_line(
    tmp_path: Path, found: object, expected: str
) -> None:
    message = error_of(tmp_path, rig_text(realtime={"cpu_latency_us": found}))
    assert message == f"{tmp_path / 'rig.yaml'}: realtime.cpu_latency_us: expected {expected}"


def test_keys_that_are_not_text_give_one_line_each(tmp_path: Path) -> None:
    message = error_of(tmp_path, rig_text(realtime={0.5: 1, 1.5: 2}))
    assert [line.partition(": realtime.")[2] for line in message.splitlines()] == [
        "0.5: expected a key that is text, found 0.5",
        "1.5: expected a key that is text, found 1.5",
    ]


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        ("{push_n: 0}", ["check_coils.push_n: expected a number greater than 0, found 0"]),
        ("{p_s: 1}", ["check_coils.p_s: unknown key; expected 'push_s'"]),
        (
            "{push_n: 0, pause_s: -1}",
            [
                "check_coils.push_n: expected a number greater than 0, found 0",
                "check_coils.pause_s: expected a number greater than 0, found -1",
            ],
        ),
    ],
)
def test_mistakes_in_a_mapping_that_could_be_a_word_are_reported_by_key(
    tmp_path: Path, found: str, expected: list[str]
) -> None:
    session = yaml.safe_load(shipped("sessions/beam.yaml").read_text())
    (levitate,) = (step for step in session["steps"] if "levitate" in step)
    levitate["levitate"] = {"check_coils": yaml.safe_load(found)}
    path = tmp_path / "session.yaml"
    path.write_text(yaml.safe_dump(session))
    at = f"{path}: steps[{session['steps'].index(levitate)}].levitate"
    with pytest.raises(ConfigError) as caught:
        load_session(path)
    assert str(caught.value).splitlines() == [f"{at}.{line}" for line in expected]


def test_session_error_names_step_and_key(tmp_path: Path) -> None:
    text = shipped("sessions/beam.yaml").read_text().replace("name: beam-sweep", "excite: [psi]")
    path = tmp_path / "session.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"steps\[2\].record.name: required key is missing"):
        load_session(path)


def bomb(line: str, opening: str) -> str:
    """Nine levels of ten aliases each: a few hundred bytes that stand for 10^9 values."""
    levels = [f"levid: rig\na: &a {opening}"]
    for name, inner in zip("bcdefghij", "abcdefghi", strict=True):
        levels.append(f"{name}: &{name} {line.format(', '.join([f'*{inner}'] * 10))}")
    return "\n".join(levels) + "\n"


@pytest.mark.parametrize(
    "text", [bomb("[{}]", "[x, x]"), bomb("{{<<: [{}]}}", "{x: 1}")], ids=["aliases", "merges"]
)
def test_aliases_of_aliases_are_rejected_before_expansion(tmp_path: Path, text: str) -> None:
    assert f"expected at most {MOST_NODES} keys and values" in error_of(tmp_path, text)


def test_alias_may_be_used_twice(tmp_path: Path) -> None:
    text = rig_text(geometry__sensors_x_m=[0.1, 0.2])
    assert "YAML" not in error_of(tmp_path, f"{text}\nx: &a [1, 2]\ny: *a\n")


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        ("9" * 6000, "a number of at most 20000"),
        ("0x" + "f" * 6000, "a number"),
        ("1" + ":59" * 3000, "a number"),
        ("1" * 6000 + "e", "a number"),
    ],
)
def test_text_longer_than_a_number_stays_text(tmp_path: Path, number: str, expected: str) -> None:
    text = rig_text().replace("rate_hz: 1000", f"rate_hz: {number}")
    assert f"rate_hz: expected {expected}, found '{number[:56]}..." in error_of(tmp_path, text)


def test_integers_of_thousands_of_digits_are_errors(tmp_path: Path) -> None:
    text = rig_text(realtime={"priority": 1}).replace("priority: 1", "priority: " + "9" * 6000)
    assert "priority: expected an integer of fewer digits, found '9" in error_of(tmp_path, text)
    with pytest.raises(ConfigError, match="at most 64 digits, found an integer of about 6001"):
        parse({"settle_s": 10**6000}, Move, "move")
    longest = "1" * MOST_DIGITS
    with pytest.raises(ConfigError, match=f"less than 9223372036854775808, found {longest[:56]}"):
        parse_text(f"{SESSION}seed: {longest}\n", SessionConfig, "s")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("gap_m", 0.85, "0.012 m, 0.1 rad at the longest arm, found 0.85; is it in mm"),
        ("gap_m", 85.0, "0.012 m, 0.1 rad at the longest arm, found 85$"),
        ("tilt_rad", 6.5, "0.1 rad, found 6.5; is it in mrad"),
    ],
)
def test_limits_of_large_angles_are_errors(
    tmp_path: Path, name: str, value: float, said: str
) -> None:
    text = rig_text(**{f"limits__{name}": value})
    assert re.search(
        rf"rig\.yaml: .*limits\.{name}: expected at most {said}", error_of(tmp_path, text)
    )


def test_a_zero_character_is_an_error(tmp_path: Path) -> None:
    text = rig_text() + 'socket: "a\\0b"\n'
    assert "rig.yaml: socket: expected text without zero characters" in error_of(tmp_path, text)


def test_pipes_are_read_to_their_end_and_never_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("levid.config.base.PIPE_WAIT_S", 0.1)
    pipe = tmp_path / "pipe.yaml"
    os.mkfifo(pipe)
    with pytest.raises(ConfigError, match="one without an end"):  # nobody writes
        read_mapping(pipe)
    with pytest.raises(ConfigError, match="expected a file of at most 256 KiB"):
        read_mapping("/dev/zero")
    read, write = os.pipe()
    with os.fdopen(read, "rb"), os.fdopen(write, "wb", buffering=0) as writer:
        writer.write(b"a: 1")
        with pytest.raises(ConfigError, match="one without an end"):
            read_mapping(f"/dev/fd/{read}")
        writer.write(b"b: 2")
        writer.close()
        assert read_mapping(f"/dev/fd/{read}") == {"b": 2}


def test_too_large_file_is_rejected(tmp_path: Path) -> None:
    assert "expected a file of at most 256 KiB" in error_of(tmp_path, "#" * 300_000)


@pytest.mark.parametrize("depth", [2000, 50_000])
def test_too_deep_nesting_is_rejected(tmp_path: Path, depth: int) -> None:
    text = "levid: " + "[" * depth
    # The top level is a mapping.
    place = f"rig.yaml:1:{len('levid: ') + MOST_DEPTH}: "
    assert f"{place}expected at most {MOST_DEPTH} levels" in error_of(tmp_path, text)


@pytest.mark.parametrize(
    ("word", "found"),
    [("yes", "'yes'"), ("on", "'on'"), ("off", "'off'"), ("true", "true"), ("'1000'", "'1000'")],
)
def test_text_and_true_are_not_numbers(tmp_path: Path, word: str, found: str) -> None:
    text = rig_text().replace("rate_hz: 1000", f"rate_hz: {word}")
    assert f"rate_hz: expected a number, found {found}" in error_of(tmp_path, text)


@pytest.mark.parametrize(
    "number",
    [
        "020",
        "-007",
        "0x20",
        "0o20",
        "0b1010",
        "16:40",
        "190:20:30.15",
        "1_000",
        "6_8.5",
        "1.0_0",
        "+0_1",
        ".5_0",
        "1_0e3",
    ],
)
def test_what_versions_of_yaml_read_differently_is_an_error(tmp_path: Path, number: str) -> None:
    text = rig_text().replace("rate_hz: 1000", f"rate_hz: {number}")
    line = 1 + text[: text.index(f"rate_hz: {number}")].count("\n")
    said = f"rig.yaml:{line}:10: expected a decimal number such as 20, or text in quotes, found "
    assert said in error_of(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("20", 20),
        ("-3", -3),
        ("0", 0),
        ("1e-4", 1e-4),
        ("00.5", 0.5),
        ("5.", 5.0),
        ("+.5E+3", 500.0),
        (".inf", float("inf")),
        ("true", True),
        ("yes", "yes"),
        ("~", None),
        ("2024-05-01", "2024-05-01"),
        ("1.2.3", "1.2.3"),
        ("'020'", "020"),
        ("16:61", "16:61"),
        ("a_1", "a_1"),
        ("._5", "._5"),
    ],
)
def test_scalars_are_those_of_yaml_1_2(tmp_path: Path, text: str, value: object) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(f"key: {text}\n")
    found = read_mapping(path)["key"]
    assert found == value
    assert type(found) is type(value)


def test_yes_is_not_a_number_in_a_list(tmp_path: Path) -> None:
    text = rig_text(geometry__coil_x_m=[0.1, True, 0.0])
    assert "geometry.coil_x_m: expected a number, found true" in error_of(tmp_path, text)
    model = shipped("models/rig.yaml").read_text().replace("fixed: true", "fixed: True")
    path = tmp_path / "model.yaml"
    path.write_text(model)
    assert (
        load_yaml(path, ModelConfig).parameters["g"].fixed
    )  # valid for a key that is true or false


def test_rig_of_any_number_of_coils() -> None:
    data = yaml.safe_load(rig_text())
    data["geometry"] = {"coil_x_m": [0.1, -0.1, 0.0, 0.1], "coil_y_m": [0.1, 0.1, -0.1, -0.1]}
    assert len(RigConfig.model_validate(data).geometry.sensors_x_m) == 4


def test_numbers_with_squares_that_overflow_are_config_errors(
    tmp_path: Path,
) -> None:
    text = shipped("sims/nominal.yaml").read_text()
    data = yaml.safe_load(text)
    data["platform"]["j_psitheta_kg_m2"] = 1e200
    path = tmp_path / "sim.yaml"
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError, match="expected its square below"):
        load_any(path)
    data = yaml.safe_load(text)
    data["geometry"]["coil_x_m"][0] = 1e200
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError):
        load_any(path)


def test_invalid_file_name_is_a_config_error() -> None:
    with pytest.raises(ConfigError, match="cannot be read: embedded null byte"):
        load_rig(Path("a\0b.yaml"))


FEWEST_REPEATS, MOST_REPEATS = 2, 7
LINEAR = 5.0
"""Four times the work takes four times as long: what shows this needs no further repeats."""


def growth(work: Callable[[int], object], size: int) -> float:
    """Return the ratio of the CPU times of four times the work and the work.

    Each is the least of several, in turn: other programs share the caches.
    """

    def taken_s(size: int) -> float:
        start = time.process_time()
        work(size)
        return time.process_time() - start

    gc.collect()
    gc.disable()  # a collection visits the objects of all tests
    try:
        pairs: list[tuple[float, float]] = []
        while len(pairs) < MOST_REPEATS:
            pairs.append((taken_s(4 * size), taken_s(size)))
            more, less = (min(times) for times in zip(*pairs, strict=True))
            found = more / max(less, 5e-3)
            if len(pairs) >= FEWEST_REPEATS and found < LINEAR:
                break
    finally:
        gc.enable()
    return found


def message_of(work: Callable[[], object]) -> str:
    with pytest.raises(ConfigError) as caught:
        work()
    return str(caught.value)


TEXTS: dict[str, tuple[int, Callable[[int], str]]] = {
    "digits": (50_000, lambda n: f"seed: {'1' * n}e\n"),
    "fraction": (50_000, lambda n: f"seed: 1.{'1' * n}e\n"),
    "blanks in a date": (50_000, lambda n: f"seed: 2001-01-01{' ' * n}x\n"),
    "words": (20_000, lambda n: f"seed: {'a ' * n}\n"),
    "unknown keys": (1000, lambda n: "".join(f"k{i}: 1\n" for i in range(n))),
    "keys that are numbers": (1000, lambda n: "".join(f"{i}.5: 1\n" for i in range(n))),
    "wrong items": (1000, lambda n: f"then: [{'x,' * n}]\n"),
    "merges": (1000, lambda n: f"a: &a {{x: 1}}\nb: {{{'<<: *a,' * n}}}\n"),
    "lists in lists": (500, lambda n: f"then: [{'[[[]]],' * n}]\n"),
    "comments": (20_000, lambda n: "#\n" * n + "x: 1\n"),
}


@pytest.mark.parametrize("size, text", TEXTS.values(), ids=TEXTS)  # noqa: PT006
def test_time_to_read_is_linear(size: int, text: Callable[[int], str]) -> None:
    def read(size: int) -> None:
        message = message_of(lambda: parse_text(SESSION + text(size), SessionConfig, "s"))
        assert len(message) < 12_000

    assert growth(read, size) < 8


DATA: dict[str, Callable[[int], object]] = {
    "unknown keys": lambda n: {f"k{i}": 1 for i in range(n)},
    "keys that are numbers": lambda n: {i + 0.5: 1 for i in range(n)},
    "alternatives": lambda n: {"service": {"allow_users": [[] for _ in range(n)]}},
    "wrong keys of a mapping": lambda n: {"can": {f"!{i}": 1 for i in range(n)}},
}


@pytest.mark.parametrize("data", DATA.values(), ids=DATA)
def test_time_to_list_mistakes_is_linear(data: Callable[[int], object]) -> None:
    assert growth(lambda n: message_of(lambda: parse(data(n), RigConfig, "r")), 1500) < 8


def test_first_mistakes_are_listed_and_the_rest_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = []

    def counted(*arguments: object, **options: object) -> list[str]:
        calls.append(arguments)
        return []

    monkeypatch.setattr(difflib, "get_close_matches", counted)
    text = SESSION + "".join(f"k{i}: 1\n" for i in range(5000))
    lines = message_of(lambda: parse_text(text, SessionConfig, "s")).splitlines()
    assert len(calls) == MOST_MISTAKES
    assert len(lines) == MOST_MISTAKES + 1
    assert lines[0].startswith("s: k0: unknown key; expected one of ")
    assert lines[-1] == f"s: {5000 - MOST_MISTAKES} more mistakes, not listed"


def test_one_unlisted_mistake_is_counted_in_the_singular() -> None:
    text = SESSION + "".join(f"k{i}: 1\n" for i in range(MOST_MISTAKES + 1))
    assert message_of(lambda: parse_text(text, SessionConfig, "s")).endswith(
        "\ns: 1 more mistake, not listed"
    )


def test_long_key_is_quoted_in_part() -> None:
    longest = "k" * MOST_KEY
    message = message_of(lambda: parse_text(f"{SESSION}? {longest}\n: 1\n", SessionConfig, "s"))
    assert message.startswith(f"s: {'k' * 57}...: unknown key; expected one of ")
    message = message_of(lambda: parse({"move": {"k" * 100_000: 1}}, Move, "m"))
    assert message == (
        f"m: move: expected keys of at most {MOST_KEY} characters, found '{'k' * 56}..."
    )


@pytest.mark.parametrize(
    "value",
    ["x" * 200_000, ["x" * 1000] * 100, {"x": "y" * 200_000}, [[[[1] * 1000]]], b"x" * 200_000],
    ids=["text", "list", "mapping", "lists", "bytes"],
)
def test_long_value_is_quoted_in_part(value: object) -> None:
    message = message_of(lambda: parse({"beam_m": value}, Move, "m"))
    assert message.startswith("m: beam_m: expected a number, found ")
    assert message.endswith("...")
    assert len(message) < 120


def test_control_characters_in_a_key_are_escaped() -> None:
    message = message_of(lambda: parse_text(f'{SESSION}"a\\nb\\e[31m": 1\n', SessionConfig, "s"))
    assert message.startswith("s: a\\nb\\x1b[31m: unknown key")
    assert "\n" not in message


def patterns(schema: object) -> set[str]:
    if isinstance(schema, list):
        return {pattern for inner in schema for pattern in patterns(inner)}
    if not isinstance(schema, dict):
        return set()
    own = {schema["pattern"]} if isinstance(schema.get("pattern"), str) else set()
    return own | set(schema.get("patternProperties", ())) | patterns(list(schema.values()))


@pytest.mark.parametrize("kind", [*KINDS.values(), SignalsFile])
def test_every_pattern_of_a_schema_has_words(kind: type[Strict]) -> None:
    assert patterns(kind.model_json_schema()) <= set(_FORMS)
    assert "^" not in error_of_name(kind)


def error_of_name(kind: type[Strict]) -> str:
    return message_of(lambda: parse({"name": "?", "can": {"?": {}}, "columns": []}, kind, "s"))


@pytest.mark.parametrize(
    "text",
    ["a: !x{} 1", "a: &x 1\nb: *{}", "{0}: 1\n{0}: 2", "a: !!bool {}", "a: {{x: {}"],
    ids=["tag", "alias", "key", "word", "unclosed"],
)
def test_invalid_yaml_is_quoted_in_part(text: str) -> None:
    message = message_of(lambda: parse_text(text.format("y" * 1000), SessionConfig, "s"))
    assert len(message) < 400
    assert message.startswith(("s:1:", "s:2:"))


def test_number_of_levels_is_limited() -> None:
    def nested(levels: int) -> object:
        value: object = 1
        for _ in range(levels):
            value = [value]
        return value

    # The top level is a mapping.
    inner = MOST_DEPTH - 1
    text = f"{SESSION}x: {'[' * inner}{']' * inner}\n"
    assert "x: unknown key" in message_of(lambda: parse_text(text, SessionConfig, "s"))
    assert "x: unknown key" in message_of(lambda: parse({"x": nested(inner)}, Move, "m"))
    assert message_of(lambda: parse({"x": nested(inner + 1)}, Move, "m")) == (
        f"m: x{'[0]' * inner}: expected at most {MOST_DEPTH} levels of lists and mappings, found "
        "more"
    )
    chain = "a0: &a0 []\n" + "".join(f"a{i + 1}: &a{i + 1} [*a{i}]\n" for i in range(inner + 9))
    assert message_of(lambda: parse_text(chain, SessionConfig, "s")).startswith(
        f"s:{MOST_DEPTH}:{len(f'a{inner}: &a{inner} [') + 1}: expected at most {MOST_DEPTH} levels"
    )


def test_lists_that_contain_themselves_are_an_error() -> None:
    data: list[object] = []
    data.append(data)
    assert "levels of lists and mappings" in message_of(lambda: parse(data, Move, "m"))
    message = message_of(lambda: parse_text("a: &a\n  b: [*a]\n", SessionConfig, "s"))
    assert message.startswith("s:2:7: an alias refers to")


def test_reading_stops_at_the_limit_of_keys_and_values() -> None:
    # The bracket is never closed: reading stops before the end of the file.
    text = "levid: session\nsteps: [\n" + "1,\n" * MOST_NODES
    assert message_of(lambda: parse_text(text, SessionConfig, "s")) == (
        f"s:{MOST_NODES - 2}:1: expected at most {MOST_NODES} keys and values, found more "
        "(an alias counts at each use)"
    )
    message = message_of(lambda: parse({"x": [1] * MOST_NODES}, Move, "m"))
    assert message.startswith(f"m: x: expected at most {MOST_NODES} keys and values")


def test_text_of_an_alias_counts_at_each_use() -> None:
    message = message_of(
        lambda: parse_text(f"a: &a {'x' * 100_000}\nb: [*a, *a]\n", SessionConfig, "s")
    )
    assert message.startswith(f"s:2:9: expected at most {MOST_BYTES} characters of text")
    long = "x" * (MOST_BYTES // 2 + 1)
    message = message_of(lambda: parse([long, long], Move, "m"))
    assert f"expected at most {MOST_BYTES} characters of text" in message


def test_session_of_the_largest_number_of_steps_is_read() -> None:
    records = "".join(
        f"- record: {{name: r{i}, excite: [a, b], duration_s: 9, scale: 1, settle_s: 1}}\n"
        for i in range(998)
    )
    head = (
        "levid: session\nname: a\nexcitations:\n"
        "  a: {input: psi, rms_n_m: 1}\n  b: {input: z, rms_n: 1}\nsteps:\n- levitate: {}\n"
    )
    text = f"{head}{records}- land: {{}}\n"
    assert len(parse_text(text, SessionConfig, "s").steps) == 1000
    message = message_of(
        lambda: parse_text(text.replace("- land", "- move: {}\n- land"), SessionConfig, "s")
    )
    assert message == "s: steps: expected at most 1000 entries, found 1001"


def test_length_of_names_and_number_of_excitations_are_limited() -> None:
    session = yaml.safe_load(SESSION)
    assert parse({**session, "name": "x" * 100}, SessionConfig, "s").name == "x" * 100
    message = message_of(lambda: parse({**session, "name": "x" * 101}, SessionConfig, "s"))
    assert message.startswith("s: name: expected text of at most 100 characters, found 'xxx")
    excitations = {f"e{i}": {"input": "psi", "rms_n_m": 1} for i in range(1001)}
    message = message_of(lambda: parse({**session, "excitations": excitations}, SessionConfig, "s"))
    assert message == "s: excitations: expected at most 1000 entries, found 1001"


@pytest.mark.parametrize(
    "tag", ["!!python/object:os.system", "!!binary", "!!timestamp", "!!set", "!!omap", "!mine"]
)
def test_tag_outside_the_core_schema_is_an_error(tag: str) -> None:
    message = message_of(lambda: parse_text(f"levid: session\nname: {tag} x\n", SessionConfig, "s"))
    assert message == f"s:2:7: expected no tag, found '{tag}'"


def test_tag_of_the_core_schema_is_read() -> None:
    text = SESSION.replace("name: a", 'name: !!str 5\nseed: !!int "7"')
    session = parse_text(text, SessionConfig, "s")
    assert (session.name, session.seed) == ("5", 7)
    for value, expected in (
        ("!!int x", "an integer"),
        ("!!float ''", "a number"),
        ("!!int '020'", "a decimal number"),
    ):
        message = message_of(lambda value=value: parse_text(f"seed: {value}\n", SessionConfig, "s"))
        assert message.startswith(f"s:1:7: expected {expected}")


def test_date_is_text() -> None:
    text = SESSION.replace("name: a", "name: 2024-05-01")
    assert parse_text(text, SessionConfig, "s").name == "2024-05-01"
    assert parse_text(text.replace("05", "13"), SessionConfig, "s").name == "2024-13-01"


@pytest.mark.parametrize(("key", "kind"), [("? [a]\n: 1", "list"), ("{a: 1}: 1", "mapping")])
def test_key_that_is_a_list_or_a_mapping_is_an_error(key: str, kind: str) -> None:
    message = message_of(lambda: parse_text(f"{key}\n", SessionConfig, "s"))
    assert message.endswith(f": expected a key that is text, found a {kind}")


def test_mapping_may_override_a_merged_key_at_any_depth() -> None:
    # The inner mapping is merged into the outer one before it is read itself.
    text = "x: {y: {a: &a {<<: {k: 1}, k: 2}}}\nz: {<<: *a}\n"
    assert "duplicate" not in message_of(lambda: parse_text(text, SessionConfig, "s"))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('name: "\\ud800"\n', "s: name: expected Unicode text, found '\\ud800'"),
        ('"\\ud800": 1\n', "s: file: expected Unicode text, found '\\ud800'"),
        ('name: "\\UFFFFFFFF"\n', "s:1:10: not valid YAML: expected a character code"),
        ("%YAML " + "1" * 5000 + ".1\n---\n", "s:1:7: not valid YAML: expected a character code"),
        (b"name: \xb5m\n", "s: not valid YAML: expected text in UTF-8 without control characters"),
        ("name: \0\n", "s: not valid YAML: expected text in UTF-8 without control characters"),
        ("---\n---\n", "s:2:1: not valid YAML: expected a single document in the file"),
    ],
)
def test_invalid_characters_and_several_documents_are_errors(
    text: str | bytes, expected: str
) -> None:
    assert message_of(lambda: parse_text(text, SessionConfig, "s")).startswith(expected)


SCALARS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([18, 40, 6000]).map(lambda digits: 10**digits)
    | st.sampled_from(["1" * 5000, "x" * 300, "\ud800", "coil:1"])
    | st.floats()
    | st.text(max_size=20)
)
KEYS = SCALARS | st.sampled_from(
    [key for kind in KINDS.values() for key in kind.model_fields] + ["levitate", "record", "excite"]
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=20,
)
WORDS = (
    "a a:_ -_ ?_ &a_ *a <<:_ --- !!int_ !!str_ !!map_ !!set_ %YAML 1e5 0x 0b_ 1:59 .nan yes é "
    '2001-13-41 "\\ud800" "\\UFFFFFFFF" steps:_ levid:_rig'
)
PIECES = st.sampled_from(
    [*"[]{}:,-?&*!|>'\"#%@`\\ \t\n~=.\0\ufeff", "\n  ", "1" * 70]
    + [word.replace("_", " ") for word in WORDS.split()]
)


def check_is_error_or_result(work: Callable[[], object]) -> None:
    message = "s:"
    try:
        work()
    except ConfigError as error:
        message = str(error)
    assert len(message.encode()) < 12_000
    assert all(line.startswith("s:") for line in message.split("\n"))


@settings(max_examples=150, deadline=None, derandomize=True)
@given(kind=st.sampled_from(sorted(KINDS)), data=VALUES)
def test_any_data_is_a_config_error_or_a_result(kind: str, data: object) -> None:
    check_is_error_or_result(lambda: parse(data, KINDS[kind], "s"))
    if isinstance(data, dict):
        check_is_error_or_result(lambda: parse({**data, "levid": kind}, KINDS[kind], "s"))


@settings(max_examples=300, deadline=None, derandomize=True)
@given(kind=st.sampled_from(sorted(KINDS)), text=st.lists(PIECES | st.text(max_size=3)))
def test_any_text_is_a_config_error_or_a_result(kind: str, text: list[str]) -> None:
    check_is_error_or_result(lambda: parse_text("".join(text), KINDS[kind], "s"))
    written = "".join(text).encode("utf-8", "surrogatepass")
    check_is_error_or_result(lambda: parse_text(written, KINDS[kind], "s"))
