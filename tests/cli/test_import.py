"""Test six kinds of files of one motor, from `levid new signals` to the fitted parameters.

Each test does what a new user does: write a draft of the SIGNALS.yaml, change only what the draft
asks for, import, fit. The true parameters of the motor are known.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from motor_measurements import MODEL, RATE_HZ, Measurement, measured, parameters, uniform

Command = Callable[..., tuple[int, str, str]]
PRECISE = pytest.approx({"d": 1.0, "k": 1.0, "c": 1.0}, rel=2e-3)
"""Noise of 2 um on motion of 2 mm RMS leaves an error of 1e-4; k and c are known far better."""
ROWS = 2000


class Folder:
    """The folder of a user: data file, SIGNALS.yaml and logs."""

    def __init__(self, path: Path, levid: Command) -> None:
        self.path, self._levid = path, levid
        self.signals, self.log = path / "motor.yaml", path / "motor.mcap"

    def draft(self, data: Path, *changes: tuple[str, str]) -> str:
        """Write the draft for a data file, apply changes, return the text."""
        code, _, err = self._levid("new", "signals", data, "-o", self.signals)
        assert code == 0, err
        text = self.signals.read_text()
        for before, after in changes:
            assert before in text, text
            text = text.replace(before, after)
        self.signals.write_text(text)
        return text

    def load(self, data: Path) -> tuple[str, str]:
        """Import a data file; return what was printed to stdout and stderr."""
        code, out, err = self._levid("import", data, "--signals", self.signals, "-o", self.log)
        assert code == 0, err
        return out, err


@pytest.fixture
def user(tmp_path: Path, levid: Command) -> Folder:
    return Folder(tmp_path, levid)


def column(values: np.ndarray) -> np.ndarray:
    return np.asarray(values)[:, None]


def table(m: Measurement) -> np.ndarray:
    return np.stack([m.time_s, m.current_a, m.position_m], axis=1)


def write_csv(path: Path, m: Measurement, header: str = "t,current,position") -> Path:
    np.savetxt(path, table(m), delimiter=",", fmt="%.9g", header=header, comments="")
    return path


SIMULINK = np.dtype([("values", object), ("dimensions", object), ("label", object)])


def test_simulink_structure_with_time(user: Folder) -> None:
    m = uniform(ROWS)
    signals = np.zeros((1, 2), SIMULINK)
    signals[0, 0] = (column(m.current_a), 1.0, "Current [A]")
    signals[0, 1] = (column(m.position_m * 1e3), 1.0, "Position [mm]")
    data = user.path / "scope.mat"
    scope = {"time": column(m.time_s), "signals": signals, "blockName": "motor/Scope"}
    scipy.io.savemat(data, {"ScopeData": scope, "Ts": 0.002})
    text = user.draft(data)
    assert '{column: "ScopeData.signals(2).values", name: position_m, unit: m, role: output' in text
    assert "scale: 0.001" in text
    assert "ScopeData.blockName: text 'motor/Scope'" in text
    out, err = user.load(data)
    assert f"{user.log}: 2000 samples at 500 Hz" in out
    assert f"levid identify {user.log} --out" in err
    assert f"levid trace {user.log} --model MODEL.yaml --out" in err
    assert parameters(user.log) == PRECISE


@pytest.mark.parametrize("ending", ["mat", "npy", "txt"])
def test_matrix_without_names(user: Folder, ending: str) -> None:
    data, values = user.path / f"motor.{ending}", table(uniform(ROWS))
    match ending:
        case "mat":
            scipy.io.savemat(data, {"data": values.T, "note": "2nd run"})
        case "npy":
            np.save(data, values)
        case "txt":
            np.savetxt(data, values)
    text = user.draft(data)
    assert "{column: 0, name: t, unit: s, role: time}" in text
    assert ("samples: columns" in text) == (ending == "mat")
    out, err = user.load(data)
    assert "next: levid identify needs columns of role input and output" in err
    user.log.unlink()
    user.signals.write_text(
        text.replace("name: column_1, unit: \"1\", role: other", "name: i, unit: A, role: input")
        .replace("name: column_2, unit: \"1\", role: other", "name: x, unit: m, role: output")
    )  # fmt: skip
    out, _ = user.load(data)
    assert f"{user.log}: 2000 samples at 500 Hz" in out
    assert parameters(user.log) == PRECISE


@pytest.mark.parametrize(
    ("header", "separator", "comma"),
    [
        ("time/s;Current (A);Position [mm]", ";", True),
        ("Zeit;Strom;Weg\ns;A;mm", ";", True),
        ("Scope 7\nmade,by hand\nTime,Current,Position\n[s],[A],[mm]", ",", False),
        ("Time (s)\tMotor current (A)\tPosition (mm)", "\t", True),
    ],
)
def test_units_in_the_header(user: Folder, header: str, separator: str, comma: bool) -> None:
    data, values = user.path / "motor.csv", table(uniform(ROWS)) * [1.0, 1.0, 1e3]
    lines = [separator.join(f"{x:.6f}" for x in row) for row in values]
    body = "\n".join(lines)
    data.write_text(f"{header}\n{body.replace('.', ',') if comma else body}\n")
    text = user.draft(data)
    assert "role: output, scale: 0.001}" in text
    out, err = user.load(data)
    assert f"{user.log}: 2000 samples at 500 Hz" in out
    assert "warning" not in err
    # The file has six decimals of a millimetre, far less than the noise.
    assert parameters(user.log) == PRECISE


def test_unit_that_contradicts_the_header_is_a_warning(user: Folder) -> None:
    data = write_csv(user.path / "motor.csv", uniform(100), "t,current,Position [mm]")
    user.draft(data, ("role: output, scale: 0.001", "role: output"))
    _, err = user.load(data)
    assert (
        f"warning: {user.signals}: position_m: the header says mm, but unit is m with scale 1; "
        f"expected scale: 0.001, or unit: mm (header of {data})" in err
    )


def test_jittering_time_stamps(user: Folder) -> None:
    m = uniform(ROWS)
    jitter_s = 1e-4 * np.random.default_rng(1).uniform(-1.0, 1.0, ROWS)  # 5 % of the period
    late = jitter_s.copy()
    late[700] = 5e-3  # and the stamps of the two rows behind it
    late[701:703] = [3.1e-3, 1.2e-3]
    data = write_csv(user.path / "motor.csv", Measurement(m.time_s + late, *table(m).T[1:]))
    user.draft(data)
    out, _ = user.load(data)
    assert f"{user.log}: 2000 samples at 500 Hz" in out
    assert "note: time stamps jitter by up to 5.2 % of the period" in out
    assert "note: 3 time stamps are up to 2.5 periods off the grid" in out
    assert parameters(user.log) == PRECISE


def test_irregular_time_stamps(user: Folder, levid: Command) -> None:
    rng = np.random.default_rng(5)
    time_s = np.cumsum(rng.uniform(0.5, 1.5, ROWS)) / RATE_HZ
    data = write_csv(user.path / "motor.csv", measured(time_s, rng.standard_normal(ROWS)))
    text = user.draft(data)
    code, _, err = levid("import", data, "--signals", user.signals, "-o", user.log)
    assert code == 1
    assert "column 't': irregular time stamps: expected a step of 0.0019" in err
    assert "set resample: true in the signals file" in err
    user.signals.write_text(text.replace("# resample: true", "resample: true"))
    out, _ = user.load(data)
    assert "are resampled to 9" in out  # 1 / (0.55 of the mean step), two digits
    assert "note: position: resampled by cubic interpolation; error below" in out
    # The interpolation error, 1e-3 of the motion, is far above the noise.
    assert parameters(user.log) == pytest.approx({"d": 1.0, "k": 1.0, "c": 1.0}, rel=0.01)


def test_missing_samples(user: Folder) -> None:
    m = uniform(2 * ROWS)
    cells = [[f"{x:.9g}" for x in row] for row in table(m)]
    for row in (300, 301, 3000):
        cells[row][2] = ""
    cells[3900][2] = "NaN"
    kept = [row for k, row in enumerate(cells) if not (1000 <= k < 1040 or k == 2500)]
    data = user.path / "motor.csv"
    data.write_text("\n".join(map(",".join, [["t", "current", "position"], *kept])))
    user.draft(data)
    out, err = user.load(data)
    logs = [user.path / f"motor-{number}.mcap" for number in (1, 2, 3)]
    rows = [1000, 1460, 1499]
    assert out.splitlines()[:3] == [
        f"{log}: {n} samples at 500 Hz" for log, n in zip(logs, rows, strict=True)
    ]
    assert "rows are missing in the time column (40 after row 999), more than 5 in a row" in out
    # A current that changes at random every row cannot be filled in.
    assert "cannot be filled in are missing (1 missing after row 2459;" in out
    assert "note: 4 missing values of position filled in (cubic; error about 1" in out
    assert f"levid identify {' '.join(map(str, logs))} --out" in err
    assert parameters(*logs) == PRECISE


def test_clipped_input(user: Folder, levid: Command) -> None:
    data = write_csv(user.path / "motor.csv", uniform(ROWS, clip_a=1.5))
    user.draft(data, ("name: current, unit: \"1\"", "name: current_a, unit: A"))  # fmt: skip
    remark = "current_a rests at its highest value, 1.5 A, in 7"
    out, _ = user.load(data)
    assert f"note: {remark}" in out
    assert parameters(user.log) == PRECISE
    model = user.path / "model.yaml"
    model.write_text(MODEL)
    code, text, err = levid(
        "identify", user.log, "--model", model, "--out", user.path / "out", "--json"
    )
    assert code == 0
    (point,) = json.loads(text)["points"]
    assert any(remark in line for line in point["remarks"])
    # The user did not fill in the unit of the position.
    assert "warning: position is in unit 1 (none) in its signals file, but position_m in m" in err
    assert "warning: current" not in err


def test_model_of_the_motor_is_valid(tmp_path: Path, levid: Command) -> None:
    (tmp_path / "model.yaml").write_text(MODEL)
    assert levid("check", tmp_path / "model.yaml")[0] == 0


def test_draft_is_never_written_over_a_file(user: Folder, levid: Command) -> None:
    data = write_csv(user.path / "motor.csv", uniform(50))
    user.draft(data)
    code, _, err = levid("new", "signals", data, "-o", user.signals)
    assert code == 1
    assert "exists; levid does not overwrite it: give another path with -o" in err


def test_draft_without_a_rate_says_what_to_fill_in(user: Folder, levid: Command) -> None:
    data = user.path / "motor.csv"
    data.write_text("u [V],y [mm]\n" + "".join(f"{k % 3},{k % 5}\n" for k in range(60)))
    code, out, err = levid("new", "signals", data, "-o", user.signals)
    assert code == 0
    assert "fill in: rate_hz: samples per second" in out
    assert f"next: levid import {data} --signals {user.signals} --out {user.log}" in err
    code, _, err = levid("import", data, "--signals", user.signals, "-o", user.log)
    assert code == 1
    assert "rate_hz: expected a number, found 'FILL_IN'" in err
