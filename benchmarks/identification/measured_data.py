"""Identify measured data of other rigs by `levid identify`: linear parameters, errors, time.

EMPS, a drive in a cascade (both records, alone and together, controller given and unknown), two
levitated magnets with an unknown controller, current or voltage as input, once with the published
controller, and an inverted pendulum. Nothing is tuned to them. The pendulum's data are in
`tests/measured`. The others are no part of the project: `shared/data` beside the checkout, or
--data DIR. Data that are not there are left out.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.config.base import read_mapping
from levid.config.shipped import shipped
from levid.identification.subspace.response_uncertainty import SURE_95
from levid.log.importing.importer import import_file

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
PENDULUM = ROOT / "tests" / "measured" / "qube"
MINUTE = Target(most=60.0)


@dataclass(frozen=True)
class Case:
    """Data files with the content of their SIGNALS.yaml, and that of the model."""

    label: str
    files: tuple[str, ...]
    signals: tuple[Mapping[str, Any], ...]
    model: Mapping[str, Any]


def cases() -> dict[str, Case]:
    """Return the cases by key."""
    return {**_emps(), **_magnets(), **_pendulum()}


def _emps() -> dict[str, Case]:
    model = read_mapping(shipped("models/emps.yaml"))
    one, two = (read_mapping(shipped(f"signals/{name}.yaml")) for name in ("emps", "emps-pulses"))
    files = ("emps/DATA_EMPS.mat", "emps/DATA_EMPS_PULSES.mat")
    unknown = one | {"loop": {"controller": "unknown"}}
    return {
        "emps": Case("EMPS", files[:1], (one,), model),
        "emps_pulses": Case("EMPS, pulses", files[1:], (two,), model),
        "emps_both": Case("EMPS, both", files, (one, two), model),
        "emps_unknown": Case("EMPS, controller unknown", files[:1], (unknown,), model),
    }


def _magnets() -> dict[str, Case]:
    by_current = read_mapping(shipped("signals/magnetoshield.yaml"))
    model = read_mapping(shipped("models/magnetoshield.yaml"))
    volts = {"column": "result", "index": 1, "name": "u_v", "unit": "V", "role": "input"}
    by_voltage = by_current | {"columns": [by_current["columns"][0], volts], "input_hold": "zoh"}
    gain = model["parameters"]["b"] | {"value": 1.0, "unit": "m/s^2/V", "min": 0.01, "max": 50.0}
    # The current lags by L / R, 0.24 H / 198 ohm.
    voltage_model = model | {
        "inputs": [{"name": "u_v", "unit": "V"}],
        "input": "zoh",
        "parameters": model["parameters"] | {"b": gain},
        "lag_s": 0.24 / 198.0,
    }
    found = {}
    for key, board, file, Ts_s in (
        ("magnet", "MagnetoShield", "MagnetoShield_ID_Data.mat", 3.25e-3),
        ("magnet_2", "MagnetoShield, second board", "ID_PID_1300us.mat", 1.3e-3),
    ):
        for suffix, name, signals, plant in (
            ("", "current", by_current, model),
            ("_voltage", "voltage", by_voltage, voltage_model),
        ):
            rated = signals | {"rate_hz": 1.0 / Ts_s}
            files = (f"magnetoshield/{file}",)
            found[key + suffix] = Case(f"{board}, {name}", files, (rated,), plant)
    law = {"measured": "y_m", "form": "ideal", "kp": -2300.0, "ti_s": 0.1, "td_s": 0.03}
    stated = {"loop": {"controller": {"pid": {"u_v": {"loops": [law]}}}}}
    case = found["magnet_voltage"]
    signals = (case.signals[0] | stated,)
    found["magnet_stated"] = Case("published controller", case.files, signals, voltage_model)
    return found


def _pendulum() -> dict[str, Case]:
    signals, model = (read_mapping(PENDULUM / f"{name}.yaml") for name in ("signals", "model"))
    return {"pendulum": Case("QUBE-Servo", (str(PENDULUM / "qube.csv"),), (signals,), model)}


def run_levid(verb: str, case: Case, data: Path, folder: Path) -> tuple[dict[str, Any], float]:
    """Import, and identify or trace; return the JSON of `levid VERB`, and its time in s."""
    logs = []
    for number, (file, signals) in enumerate(zip(case.files, case.signals, strict=True)):
        described, log = folder / f"{number}.yaml", folder / f"{number}.mcap"
        described.write_text(yaml.safe_dump(dict(signals)))
        import_file(data / file, described, log)
        logs.append(str(log))
    model = folder / "model.yaml"
    model.write_text(yaml.safe_dump(dict(case.model)))
    command = [sys.executable, "-m", "levid.cli.main", verb, *logs, "--model", str(model)]
    begun_s = time.monotonic()
    done = subprocess.run(
        [*command, "--out", str(folder / "out"), "--json"],
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout), time.monotonic() - begun_s


def measure(data: Path, names: Sequence[str]) -> Iterator[Figure]:
    """Yield parameters with their 95 % half widths, errors in per cent, and time of every case."""
    for key, case in cases().items():
        if (names and key not in names) or not all((data / file).exists() for file in case.files):
            continue
        with tempfile.TemporaryDirectory() as folder:
            found, seconds = run_levid("identify", case, data, Path(folder))
        poles = [_pole(mode) for point in found["points"] for mode in point["model"]["modes"]]
        yield Figure(f"{key}_pole", max(poles), "1/s", f"{case.label}: largest real pole, no model")
        grey = found["grey_box"]
        for name, p in grey["parameters"].items():
            if p["se"] is not None:
                yield Figure(f"{key}_{name}", p["value"], p["unit"], f"{case.label}: {name}")
                yield Figure(f"{key}_{name}_interval", SURE_95 * p["se"], p["unit"], "  +- (95 %)")
                for band, value in _by_band(grey, name).items():
                    yield Figure(f"{key}_{name}_{band}", value, p["unit"], f"  {band} limit")
        for v in grey["validation"]:
            where = f"{key}_{v['record']}" if len(grey["validation"]) > 1 else key
            yield Figure(
                f"{where}_force",
                v["force_percent"][0],
                "%",
                f"  {v['record']}: force residual",
            )
            text = f"  {v['record']}: error of the output, {v['metric'].replace('_', ' ')}"
            if v["metric"] == "prediction":
                text += f", {v['horizon_s']:.2g} s ahead"
            yield Figure(f"{where}_output", v["percent"][0], "%", text)
        wrong = any("did not command" in note for note in found["notes"])
        yield Figure(f"{key}_wrong", float(wrong), "", "  stated controller said to be wrong")
        yield Figure(f"{key}_seconds", seconds, "s", "  time of levid identify", None, MINUTE)


def _pole(mode: Mapping[str, Any]) -> float:
    """Return a real pole in 1/s, minus infinity for a pair of complex ones."""
    if abs(mode["damping"]) < 1.0 - 1e-9:
        return -math.inf
    return -2.0 * math.pi * float(mode["frequency_hz"]) * math.copysign(1.0, mode["damping"])


def _by_band(grey: Mapping[str, Any], name: str) -> dict[str, float]:
    """Return a parameter by frequency limit; empty if the maximum likelihood gave it."""
    if not grey["balance"]:
        return {}
    return dict(zip(("low", "middle", "high"), grey["balance"]["by_band"][name], strict=True))


def main() -> None:
    """Parse the options and print the figures."""
    options = parser(__doc__ or "")
    options.add_argument(
        "--data", type=Path, default=DATA, help="folder with emps/, magnetoshield/"
    )
    options.add_argument("--case", action="append", default=[], help="only this case")
    arguments = options.parse_args()
    names = arguments.case or (["emps", "magnet"] if arguments.quick else [])
    show("Measured data of other rigs", arguments, partial(measure, arguments.data, names))


if __name__ == "__main__":
    main()
