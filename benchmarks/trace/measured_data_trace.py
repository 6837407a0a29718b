"""Trace measured data of other rigs by `levid trace`: what is found, missing force, time.

EMPS (each record and both, without friction in the model and with half of it), two levitated
magnets by their current with an unknown controller, the Silverbox (three eighths of its training
data), and an inverted pendulum. The trace of imported records was developed on these data: they
show what it says of them, not how well it does on others. The pendulum's data are in
`tests/measured`. The others are no part of the project: `shared/data` beside the checkout, or
--data DIR. Data that are not there are left out.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.table import Table

from levid.benchmarks.harness import silverbox
from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.benchmarks.identification.measured_data import DATA, Case, cases, run_levid
from levid.config.base import read_mapping
from levid.identification.subspace.response_uncertainty import SURE_95

EMPS = ("emps", "emps_pulses", "emps_both")
TRACED = (*EMPS, "magnet", "magnet_2", "pendulum")
HALF = {
    "effect": "friction.coulomb",
    "where": ["q_m"],
    "parameters": {"friction": {"value": 10.2, "unit": "N"}, "v_s": {"value": 4e-3, "unit": "m/s"}},
}
"""Half of the friction that was published for EMPS."""
SPEED_M_S, MASS_KG, FRICTION_N = 0.05, 95.11, 30.57
"""Of the published model of EMPS: mass, and dry and viscous friction together at this speed."""
LEVELS: dict[str, Callable[[dict[str, float]], float]] = {
    "friction.coulomb": lambda p: p["friction"] * math.tanh(SPEED_M_S / p["v_s"]),
    "friction.coulomb_asymmetric": lambda p: p["friction"] * math.tanh(SPEED_M_S / p["v_s"]),
    "friction.leveling_off": lambda p: p["friction"] * SPEED_M_S / (SPEED_M_S + p["v_0"]),
}
"""Mean over both directions of the size of a dry friction at that speed."""
SILVERBOX_ROWS = ((40_650, 48_841), (65_226, 73_417), (89_802, 97_993))
"""First and last rows of three eighths of the usual training data."""
MINUTE = Target(most=60.0)


def traced_cases() -> dict[str, Case]:
    """Return the cases by key."""
    known = cases()
    signals = read_mapping(silverbox.SIGNALS)
    parts = tuple(
        signals | {"name": f"silverbox-{first}", "rows": {"first": first, "last": last}}
        for first, last in SILVERBOX_ROWS
    )
    files = (f"silverbox/{silverbox.SOURCE.name}",) * len(parts)
    box = Case("Silverbox", files, parts, read_mapping(silverbox.MODEL))
    half = {
        f"{key}_half": replace(
            known[key],
            label=f"{known[key].label}, half of the friction declared",
            model={**known[key].model, "effects": [HALF]},
        )
        for key in EMPS
    }
    return {**{key: known[key] for key in TRACED}, **half, "silverbox": box}


def words(effect: dict[str, Any]) -> str:
    """Return an effect with its parameters and their 95 % intervals."""
    values = ", ".join(
        f"{name} {p['value']:.4g}" + ("" if p["se"] is None else f" +- {SURE_95 * p['se']:.2g}")
        for name, p in effect["parameters"].items()
    )
    return effect["name"] if effect["class"] == "unknown" else f"{effect['name']} ({values})"


def emps_figures(key: str, label: str, model: Mapping[str, Any]) -> Iterator[Figure]:
    """Yield mass and symmetric friction of a found model of EMPS, over the published ones."""
    values = {name: p["value"] for name, p in model["parameters"].items()}
    found = {e["effect"]: {n: p["value"] for n, p in e["parameters"].items()}
             for e in model.get("effects", ())}  # fmt: skip
    dry = [LEVELS[effect](numbers) for effect, numbers in found.items() if effect in LEVELS]
    force = sum(dry) + values["fv"] * SPEED_M_S
    for name, value, published, about in (
        ("mass", values["m"], MASS_KG, "mass"),
        ("friction", force, FRICTION_N, f"friction at {SPEED_M_S:g} m/s"),
    ):
        yield Figure(
            f"{key}_{name}",
            100.0 * (value / published - 1.0),
            "%",
            f"{label}: {about} over the published",
            target=Target(least=-6.0, most=6.0),
        )


def main() -> None:
    """Trace every case and print the figures."""
    options = parser("Trace of measured data; --quick: the pendulum alone")
    options.add_argument("--data", type=Path, default=DATA, metavar="DIR")
    options.add_argument("--case", action="append", default=[], choices=traced_cases())
    arguments = options.parse_args()
    names: Sequence[str] = arguments.case or (("pendulum",) if arguments.quick else ())
    table = Table("records", "found")

    def measure() -> Iterator[Figure]:
        for key, case in traced_cases().items():
            there = all((arguments.data / file).exists() for file in case.files)
            if (names and key not in names) or not there:
                continue
            with tempfile.TemporaryDirectory() as folder:
                found, seconds = run_levid("trace", case, arguments.data, Path(folder))
                model = read_mapping(Path(found["model"]))
            effects = "; ".join(words(e) for e in found["effects"]) or "nothing confirmed"
            table.add_row(case.label, effects)
            for name, dof in found["validation"]["per_dof"].items():
                for when in ("before", "after"):
                    percent = dof["force_percent"][when]
                    label = f"{case.label}: missing force at {name}, {when}"
                    yield Figure(f"{key}_{name}_{when}", percent, "%", label)
            if key.startswith("emps"):
                yield from emps_figures(key, case.label, model)
            yield Figure(f"{key}_seconds", seconds, "s", "  time of levid trace", target=MINUTE)

    show("Trace of measured data", arguments, measure, lambda: [table])


if __name__ == "__main__":
    main()
