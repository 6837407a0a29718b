"""Read hidden-effect-cases.yaml: simulated effects with their true parameters and sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

TIMES = (1.5, 5.0, 20.0)
"""Sizes: the error of the declared model, refitted, over the noise floor."""
_FILE = Path(__file__).with_name("hidden-effect-cases.yaml")
_TABLE = yaml.safe_load(_FILE.read_text(encoding="utf-8"))
_MODULES = {
    "cases": "levid.sim.effects.",
    "unlisted": "levid.benchmarks.trace.simulated_unlisted_effects:",
}


@dataclass(frozen=True)
class Case:
    """One effect: what `levid trace` should report of it, and how it is simulated.

    kind, where: class and places of the report. alike: classes that fit the data equally.
    implied: places that follow from another, such as the torque of a force; they do not count.
    absorbed: the parameters by which a refit of the declared model removes it. signals: what an
    unlisted effect depends on; each of a set is enough, and the first set is required. unseen: the
    trace was never changed because of a result of this case.

    use, values: the entry in a SIM.yaml at scale 1. size: the values to scale, and the power of the
    scale for each. scales: the scale for each of TIMES, found in flights. If the case is absorbed
    or not `sized` (only the drives feel it), no error tells its size.
    """

    name: str
    kind: str
    where: tuple[str, ...]
    use: str
    values: Mapping[str, Any]
    size: Mapping[str, float]
    scales: tuple[float, ...]
    alike: tuple[str, ...] = ()
    implied: tuple[str, ...] = ()
    absorbed: str = ""
    sized: bool = True
    signals: tuple[frozenset[str], ...] = ()
    unseen: bool = False

    @property
    def visible(self) -> bool:
        """Whether the effect leaves an error in the gaps of a refitted model."""
        return self.sized and not self.absorbed

    def effect(self, times: float) -> dict[str, Any]:
        """Return the entry of a SIM.yaml for an error of `times` the noise floor."""
        values, scale = dict(self.values), self.scales[TIMES.index(times)]
        for key, power in self.size.items():
            by, value = scale**power, values[key]
            values[key] = [by * v for v in value] if isinstance(value, list) else by * value
        return {"use": self.use, **values}


def _read(section: str) -> tuple[Case, ...]:
    cases = []
    for name, entry in _TABLE[section].items():
        row = {key: tuple(v) if isinstance(v, list) else v for key, v in entry.items()}
        kind, size = row.pop("class", "unknown"), row.pop("size")
        size = size if isinstance(size, dict) else dict.fromkeys(size, 1)
        use = _MODULES[section] + row.pop("use")
        signals = tuple(map(frozenset, row.pop("signals", ())))
        cases.append(Case(name=name, kind=kind, use=use, size=size, signals=signals, **row))
    return tuple(cases)


CASES = _read("cases")
"""Effects of levid.sim.effects, whose equations the table of effects lists."""
UNLISTED = _read("unlisted")
"""Effects of simulated_unlisted_effects.py, whose equations no table lists."""
FLOOR_M = float(_TABLE["floor_m"])
"""Noise floor of a plant without effects, m rms over rows and sensors."""
