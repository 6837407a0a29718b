"""Hostile texts in files, logs and results are text in all that commands print, draw and write."""

from __future__ import annotations

import json
import re
import shlex
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hostile_text import HOSTILE, MARK, PRINTABLE, STEERING, check_page, check_printed, check_svg
from schema_samples import Path as Place
from schema_samples import at, changed, paths

from levid.config.escaping import shell_word
from levid.config.shipped import shipped
from levid.log.reader import read_log
from levid.log.writer import LogWriter

Command = Callable[..., tuple[int, str, str]]
ALL = " ".join(text for name, text in PRINTABLE.items() if name not in ("option", "long"))
"""All hostile texts that print, in one."""
STEER = "".join(t for name, t in STEERING.items() if name not in ("zero", "half a surrogate pair"))
LONG = ("rigs/canfd.yaml", "sessions/trace-short.yaml", "models/rig.yaml")
FILES = (
    *("rigs/loopback.yaml", "rigs/serial.yaml", "sims/nominal.yaml", "signals/silverbox.yaml"),
    *(pytest.param(name, marks=pytest.mark.long) for name in LONG),
)
UNIT_LINE = re.compile(r"#.*|\[\w+\]|\w+=.*|[A-Z]+(\{\w+\})?[=!]=.*|u levid.*|")
UNIT_WORD = re.compile(r'(?:[^\s"\\%$]|%%|\$\$)+|"(?:[^"\\%$]|%%|\$\$|\\\\|\\")*"')
MODEL = """
levid: model
name: {name}
about: {about}
dof: [{{name: x_m, unit: m}}]
inputs: [{{name: f_n, unit: N}}]
parameters:
  m: {{value: 2.0, unit: kg, min: 0.1, max: 20, about: {about}}}
M: [[m]]
D: [[12.0]]
K: [[800.0]]
"""


def check_outcome(outcome: tuple[int, str, str]) -> tuple[int, str, str]:
    """Check what a command printed."""
    check_printed(outcome[1])
    check_printed(outcome[2])
    return outcome


def check_written(folder: Path) -> int:
    """Check all pages and figures in a folder; return their number."""
    pages, figures = list(folder.rglob("*.html")), list(folder.rglob("*.svg"))
    for page in pages:
        check_page(page.read_text(encoding="utf-8"))
    for figure in figures:
        check_svg(figure.read_text(encoding="utf-8"))
    return len(pages) + len(figures)


def texts_of(data: Any) -> Iterator[Place]:
    """Yield the paths of the texts in a file, but not of its kind."""
    for path in paths(data):
        if path and isinstance(at(data, path), str) and path != ("levid",):
            yield path


@pytest.mark.parametrize("name", FILES)
def test_check_answers_cleanly_for_every_text_of_a_file(
    name: str, levid: Command, tmp_path: Path
) -> None:
    data = yaml.safe_load(shipped(name).read_text())
    file = tmp_path / "file.yaml"
    for path in texts_of(data):
        for text in (ALL, STEER):
            file.write_text(yaml.safe_dump(changed(data, path, text)))
            check_outcome(levid("check", file))


def test_unit_and_rules_hold_a_rigs_texts_as_text(levid: Command, tmp_path: Path) -> None:
    data = yaml.safe_load(shipped("rigs/serial.yaml").read_text())
    data["recording"] = {"root": "/data/logs", "faults": "/data/faults"}
    data["socket"] = "/run/levid/socket"
    data["model"], data["sim"] = str(shipped("models/rig.yaml")), str(shipped("sims/nominal.yaml"))
    port = ("serial", next(iter(data["serial"])), "port")
    file = tmp_path / "rig.yaml"
    installed = 0
    for path in texts_of(data):
        for text in PRINTABLE.values():
            for start in ("", "/dev/"):
                file.write_text(yaml.safe_dump(changed(data, path, start + text)))
                code, out, err = check_outcome(levid("install-service", file, "--dry-run"))
                installed += code == 0
                for line in out.splitlines() if code == 0 else ():
                    assert re.fullmatch(
                        r"#.*|\[\w+\]|\w+=.*|[A-Z]+(\{\w+\})?[=!]=.*|u levid.*|", line
                    )
                    if MARK in line and not line.startswith("#"):
                        key, _, value = line.partition("=")
                        assert key in ("ReadWritePaths", "RequiresMountsFor"), line
                        assert re.fullmatch(r'"(?:[^"\\%]|%%|\\\\|\\")*"', value), line
                assert code == 0 or path == port or "Traceback" not in err
    assert installed


def test_a_program_and_rig_of_any_name_stay_one_argument(tmp_path: Path) -> None:
    from levid.config.base import ConfigError
    from levid.config.rig import load_rig
    from levid.daemon.service.service_files import DROP_IN, service_files

    rig = load_rig(shipped("rigs/loopback.yaml"))
    for what, text in HOSTILE.items():
        file = tmp_path / text.replace("/", "_").replace("\0", "_")[:200]
        try:
            unit = service_files(rig, file, Path("/opt/levid"))[DROP_IN]
        except ConfigError:
            assert what in STEERING
            continue
        start = next(line for line in unit.splitlines() if line.startswith("ExecStart=/"))
        assert re.fullmatch(
            r'ExecStart=/opt/levid run (\S+|"(?:[^"\\%$]|%%|\$\$|\\\\|\\")*")', start
        )


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_shell_reads_a_printed_word_as_the_same_text(shell: str, tmp_path: Path) -> None:
    texts = [text for text in HOSTILE.values() if "\0" not in text and "\ud800" not in text]
    texts += ["", "-x", "~", "=ls", "a b", "*", "\udcff", "!!", "#", "a\\", "it's"]
    words = " ".join(map(shell_word, texts))
    assert not re.search("[\x00-\x1f\x7f-\x9f\u202e]", words), "a terminal would swallow them"
    script = ["-c", f"printf '%s\\0' {words}"]
    found = subprocess.run([shell, "-f"[: 2 * (shell == "zsh")] or "--norc", *script],
                           capture_output=True, check=True, cwd=tmp_path)  # fmt: skip
    read = [part.decode(errors="surrogateescape") for part in found.stdout.split(b"\0")[:-1]]
    assert read == texts
    assert not list(tmp_path.iterdir())
    assert shell_word(Path("-x")) == "./-x"


@pytest.fixture(scope="module")
def table() -> np.ndarray:
    """Force in N and position in m of a mass on a spring, at 100 Hz."""
    rng = np.random.default_rng(1)
    force = rng.standard_normal(600)
    position, speed, rows = 0.0, 0.0, []
    for f in force:
        rows.append((f, position + 1e-6 * rng.standard_normal()))
        for _ in range(10):
            speed += 1e-3 * (f - 12.0 * speed - 800.0 * position) / 2.0
            position += 1e-3 * speed
    return np.array(rows)


def test_imported_headers_are_text_in_draft_log_pages_and_figures(
    table: np.ndarray, levid: Command, tmp_path: Path
) -> None:
    headers = {
        "data.csv": ("f \x1b[2J\u202e" + ALL.replace('"', '""'), f"x\u2028{MARK}: 1\x9b"),
        "data.txt": ("f\x1b[2J", f"$x^{{{MARK}$"),
    }
    for file, names in headers.items():
        data, signals = tmp_path / file, tmp_path / f"{file}.yaml"
        quoted = ",".join(f'"{name}"' for name in names)
        np.savetxt(data, table, delimiter=",", header=quoted, comments="", encoding="utf-8")
        check_outcome(levid("new", "signals", data, "-o", signals))
        if signals.exists():
            check_printed(signals.read_text(encoding="utf-8"))
    names = headers["data.csv"]
    columns = [
        {"column": names[0].replace('""', '"'), "name": "f_n", "unit": "N", "role": "input"},
        {"column": names[1], "name": "x_m", "unit": f'm}}" * {{ {MARK} $', "role": "output"},
    ]
    described = {"levid": "signals", "rate_hz": 100, "columns": columns}
    name = "".join(PRINTABLE[key] for key in ("HTML", "CSS", "mathtext", "markup")) + "日本 😀"
    name = name.replace("/", "_")
    signals, log = tmp_path / "signals.yaml", tmp_path / f"{name}.mcap"
    signals.write_text(yaml.safe_dump(described))
    code, _, err = check_outcome(
        levid("import", tmp_path / "data.csv", "--signals", signals, "-o", log)
    )
    assert code == 0, err
    columns[1]["unit"] = "m"
    signals.write_text(yaml.safe_dump(described))
    log.unlink()
    assert levid("import", tmp_path / "data.csv", "--signals", signals, "-o", log)[0] == 0
    model = tmp_path / "model.yaml"
    about = json.dumps(" ".join(t for t in HOSTILE.values() if not {"\0", "\ud800"} & {*t}))
    model.write_text(MODEL.format(name=json.dumps(ALL[:100]), about=about))
    found = tmp_path / f"found {name}"
    code, _, err = check_outcome(levid("identify", log, "--model", model, "--out", found))
    assert code == 0, err
    assert "Warning" not in err, err
    assert check_written(found) > 2
    assert MARK in (found / "index.html").read_text(encoding="utf-8")
    check_outcome(levid("check", found / "model.yaml"))
    check_outcome(levid("plot", log, "-o", tmp_path / "plot.png"))


def hostile_log(source: Path, target: Path, text: str) -> Path:
    """Write a log with a hostile text in every metadata value, attachment and version."""
    log = read_log(source)
    facts = {key: text for key in (*log.metadata, "note", text) if key not in ("format", "rate_hz")}
    attached = {
        **log.attachments,
        "versions.json": json.dumps({"levid": text, text: text}).encode(),
        "rig.yaml": yaml.safe_dump({"levid": "rig", "name": text}).encode("utf-8", "replace"),
        text.replace("\0", ""): text.encode("utf-8", "replace"),
    }
    dtype, rate_hz = log.rows.dtype, log.rate_hz
    with LogWriter(target, dtype, rate_hz=rate_hz, metadata=facts, attachments=attached) as writer:
        writer.write(log.rows, log.log_time_ns)
    return target


@pytest.fixture(scope="module")
def flown() -> Path:
    """A short log of the rig."""
    return Path(__file__).parents[1] / "data" / "da9bfb8" / "short.mcap"


@pytest.mark.parametrize("what", [name for name in HOSTILE if name != "half a surrogate pair"])
def test_a_logs_facts_are_text_in_every_command(
    what: str, flown: Path, levid: Command, tmp_path: Path
) -> None:
    log = hostile_log(flown, tmp_path / "log.mcap", HOSTILE[what])
    check_outcome(levid("check", log))
    for command in (
        *(("info", log), ("info", log, "--json"), ("list", tmp_path), ("salvage", log)),
        ("plot", log, "z_m", "-o", tmp_path / "z.svg"),
        ("export", log, "-o", tmp_path / "log.csv"),
        ("identify", log, "--model", tmp_path / "none.yaml", "--out", tmp_path / "found"),
    ):
        code, out, err = check_outcome(levid(*command))
        assert code in (0, 1), err
        if "--json" in command and code == 0:
            json.loads(out)
    assert check_written(tmp_path)
    if (described := tmp_path / "log.signals.yaml").exists():
        check_printed(described.read_text())
        assert set(yaml.safe_load(described.read_text())) <= {
            *("levid", "rate_hz", "begins_s", "loop", "columns"),
        }


def test_a_logs_topic_schema_and_fields_are_text(
    flown: Path, levid: Command, tmp_path: Path
) -> None:
    log = read_log(flown)
    for number, text in enumerate(HOSTILE.values()):
        if "\ud800" in text:
            continue
        dtype = np.dtype([("z_m", "f8"), (text[:200], "f8")])
        rows = np.zeros(50, dtype)
        path = tmp_path / f"{number}.mcap"
        lines = f"float64 z_m # [m {text}]\nfloat64 {text[:200]} # [{text}]"
        with LogWriter(path, dtype, rate_hz=100, metadata={}, attachments={}, topic=text,
                       schema_name=text, schema=lines) as writer:  # fmt: skip
            writer.write(rows, log.log_time_ns[:50])
        for command in (("check", path), ("info", path), ("plot", path, "z_m"), ("salvage", path)):
            check_outcome(levid(*command))


def test_results_of_any_text_are_compared_and_listed_as_text(
    levid: Command, tmp_path: Path
) -> None:
    parameters = {name: {"value": 1.0, "se": 0.1, "unit": text} for name, text in HOSTILE.items()}
    result = {
        "command": "identify",
        "logs": list(HOSTILE.values()),
        "points": [],
        "grey_box": {"parameters": parameters, "unidentifiable": list(HOSTILE.values())},
        "answer": "\n".join(HOSTILE.values()),
        "validation": {"before": 2.0, "after": 1.0, "noise_floor": 1.0, "metric": ALL},
        "effects": [{"name": text, "class": text, "where": [text], "parameters": {text: {
            "value": 1.0, "se": 0.1, "unit": text}}} for text in HOSTILE.values()],
    }  # fmt: skip
    for command in ("identify", "trace"):
        for half in ("a", "b"):
            folder = tmp_path / command / half
            folder.mkdir(parents=True)
            (folder / "result.json").write_text(json.dumps(result | {"command": command}))
        first, second = tmp_path / command / "a", tmp_path / command / "b"
        for text in HOSTILE.values():  # as the names of folders below the one that is listed
            name = text.replace("/", "_").replace("\0", "_").replace("\ud800", "_")[:80]
            (first / name).mkdir()
            (first / name / "result.json").write_text(json.dumps(result))
        check_outcome(levid("compare", first, second, "--out", tmp_path / command / "out"))
        check_outcome(levid("info", first))
    check_outcome(levid("list", tmp_path))
    check_written(tmp_path)


def test_paths_of_any_name_are_printed_as_commands_that_name_them(
    table: np.ndarray, levid: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for text in HOSTILE.values():
        name = text.replace("/", "_").replace("\0", "_").replace("\ud800", "\udcff")[:150]
        folder = Path("-" + name)
        folder.mkdir()
        data = folder / "data.csv"
        np.savetxt(data, table, delimiter=",", header="f,x", comments="")
        code, out, err = levid("new", "signals", f"./{data}", "-o", f"./{folder}/signals.yaml")
        assert code == 0 or ("file name without" in err and text in STEERING.values()), err
        for line in (out + err).splitlines():
            assert not re.search("[\x00-\x1f\x7f-\x9f\u2028\u202e]", line)
            if line.startswith("next: levid import") and "$'" not in line:
                assert Path(shlex.split(line)[3]) == data


def test_status_for_systemd_is_one_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from levid.daemon.service.systemd_notify import Notify

    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        notify = Notify()
        for text in HOSTILE.values():
            notify.status(text)
            message = systemd.recv(1 << 16).decode()
            assert message.startswith("STATUS=")
            assert message.isprintable()


def test_all_lines_of_a_log_line_are_one_entry(capfd: pytest.CaptureFixture[str]) -> None:
    from levid.daemon.service.journal import Journal

    journal = Journal()
    for text in HOSTILE.values():
        journal.log(text)
    journal.close()
    check_printed(capfd.readouterr().err)
