"""A bad file is an error that names file, key, what was expected and what came."""

from pathlib import Path

import pytest
import yaml

from levid.config.base import ConfigError, load_yaml
from levid.config.kinds import load_any
from levid.config.model import ModelConfig
from levid.config.rig import RigConfig, load_rig
from levid.config.session import load_session
from levid.config.shipped import shipped

CONFIG = Path(shipped("rigs/loopback.yaml")).parent.parent


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


def test_unknown_key_names_the_likely_one(tmp_path: Path) -> None:
    assert "limits.coil_nn: unknown key; expected 'coil_n'" in error_of(
        tmp_path, rig_text(limits__coil_nn=20)
    )


def test_wrong_unit_is_named_by_the_key_it_should_be(tmp_path: Path) -> None:
    message = error_of(tmp_path, rig_text(limits__gap_mm=0.85))
    assert "limits.gap_mm" in message
    assert "'gap_m'" in message


def test_impossible_value_says_what_was_expected_and_found(tmp_path: Path) -> None:
    message = error_of(tmp_path, rig_text(limits__coil_n=-20))
    assert "limits.coil_n: expected greater than 0, found -20" in message


def test_text_where_a_number_belongs(tmp_path: Path) -> None:
    message = error_of(tmp_path, rig_text(rate_hz="1 kHz"))
    assert "rate_hz: expected a valid number" in message
    assert "'1 kHz'" in message


def test_loop_that_is_killed_between_two_of_its_periods_is_refused(tmp_path: Path) -> None:
    message = error_of(tmp_path, rig_text(rate_hz=10, service={"loop_s": 0.299}))
    assert "service.loop_s: expected at least 0.3 s, 3 periods at 10 Hz, found 0.299 s" in message
    path = tmp_path / "rig.yaml"
    path.write_text(rig_text(rate_hz=10, service={"loop_s": 0.3}))
    assert load_rig(path).service.loop_s == 0.3


def test_missing_key(tmp_path: Path) -> None:
    data = yaml.safe_load(rig_text())
    del data["control"]["z"]
    assert "control.z: required key is missing" in error_of(tmp_path, yaml.safe_dump(data))


def test_not_yaml_names_line_and_column(tmp_path: Path) -> None:
    assert "rig.yaml:3:1: not valid YAML" in error_of(tmp_path, "levid: rig\nname: [unclosed\n")


def test_key_that_stands_twice(tmp_path: Path) -> None:
    assert "'name' stands twice" in error_of(tmp_path, "levid: rig\nname: a\nname: b\n")


@pytest.mark.parametrize("text", ["", "- a\n- b\n", "just text", "\x00\x01", "a: &x [*x]\n"])
def test_what_is_no_mapping_is_an_error_without_traceback(tmp_path: Path, text: str) -> None:
    error_of(tmp_path, text)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "none.yaml", tmp_path):
        with pytest.raises(ConfigError, match="cannot be read"):
            load_rig(path)


def test_another_kind_of_file_says_so(tmp_path: Path) -> None:
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
        ("often", "a valid integer or 'auto', found 'often'"),
        (0.5, "a valid integer or 'auto', found 0.5"),
        (-5, "greater than or equal to 0 or 'auto', found -5"),
        ([0, 1], "a valid integer or 'auto', found [0, 1]"),
    ],
)
def test_a_key_that_takes_this_or_that_is_one_line(
    tmp_path: Path, found: object, expected: str
) -> None:
    said = error_of(tmp_path, rig_text(realtime={"cpu_latency_us": found}))
    assert said == f"{tmp_path / 'rig.yaml'}: realtime.cpu_latency_us: expected {expected}"


def test_keys_that_are_no_text_are_a_line_each(tmp_path: Path) -> None:
    said = error_of(tmp_path, rig_text(realtime={0.5: 1, 1.5: 2}))
    assert [line.partition(": realtime.")[2] for line in said.splitlines()] == [
        "0.5: expected a key that is text, found 0.5",
        "1.5: expected a key that is text, found 1.5",
    ]


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        ("{push_n: 0}", ["check_coils.push_n: expected greater than 0, found 0"]),
        ("{p_s: 1}", ["check_coils.p_s: unknown key; expected 'push_s'"]),
        (
            "{push_n: 0, pause_s: -1}",
            [
                "check_coils.push_n: expected greater than 0, found 0",
                "check_coils.pause_s: expected greater than 0, found -1",
            ],
        ),
    ],
)
def test_a_mapping_in_place_of_a_word_is_told_by_its_keys(
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


def test_session_names_step_and_key(tmp_path: Path) -> None:
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
def test_aliases_of_aliases_are_refused_before_they_unfold(tmp_path: Path, text: str) -> None:
    assert "expected at most 50000 keys and values" in error_of(tmp_path, text)


def test_an_alias_used_twice_is_no_harm(tmp_path: Path) -> None:
    text = rig_text(geometry__sensors_x_m=[0.1, 0.2])
    assert "YAML" not in error_of(tmp_path, f"{text}\nx: &a [1, 2]\ny: *a\n")


@pytest.mark.parametrize("number", ["9" * 6000, "0x" + "f" * 6000, "1" + ":59" * 3000])
def test_integers_of_thousands_of_digits_are_refused_unread(tmp_path: Path, number: str) -> None:
    text = rig_text().replace("rate_hz: 1000", f"rate_hz: {number}")
    assert f"integer of at most 40 digits, found {len(number)}" in error_of(tmp_path, text)


def test_a_file_of_any_size_is_refused_by_its_size(tmp_path: Path) -> None:
    assert "expected a file of at most 256 KiB" in error_of(tmp_path, "#" * 300_000)


@pytest.mark.parametrize("depth", [2000, 50_000])
def test_brackets_without_end_are_refused(tmp_path: Path, depth: int) -> None:
    assert "not valid YAML: nested too deeply" in error_of(tmp_path, "levid: " + "[" * depth)


@pytest.mark.parametrize("word", ["yes", "on", "no", "off", "true"])
def test_yes_is_no_number(tmp_path: Path, word: str) -> None:
    text = rig_text().replace("rate_hz: 1000", f"rate_hz: {word}")
    found = word in ("yes", "on", "true")
    assert f"rate_hz: expected a number, found {found}" in error_of(tmp_path, text)


def test_yes_is_no_number_in_a_list_either(tmp_path: Path) -> None:
    text = rig_text(geometry__coil_x_m=[0.1, True, 0.0])
    assert "geometry.coil_x_m: expected a number, found True" in error_of(tmp_path, text)
    model = shipped("models/rig.yaml").read_text().replace("fixed: true", "fixed: yes")
    path = tmp_path / "model.yaml"
    path.write_text(model)
    assert load_yaml(path, ModelConfig).parameters["g"].fixed  # where it belongs it is good


def test_rig_of_any_number_of_coils() -> None:
    data = yaml.safe_load(rig_text())
    data["geometry"] = {"coil_x_m": [0.1, -0.1, 0.0, 0.1], "coil_y_m": [0.1, 0.1, -0.1, -0.1]}
    assert len(RigConfig.model_validate(data).geometry.sensors_x_m) == 4


def test_numbers_whose_squares_overflow_are_refused_and_not_met_in_a_traceback(
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


def test_a_name_that_no_file_can_have_is_an_error_like_any_other() -> None:
    with pytest.raises(ConfigError, match="cannot be read: embedded null byte"):
        load_rig(Path("a\0b.yaml"))
