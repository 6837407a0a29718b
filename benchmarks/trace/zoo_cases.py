"""The zoo: every effect that the simulator knows, at a nominal size and with one number to scale.

The table is zoo-cases.yaml. At scale 1 the closed loop of the session `trace-short` differs from
the same flight without the effect by about five times the noise of a gap (rms over all gaps and
records), or as much as physics allows; what a refit of the declared model takes up of it is not
yet taken off.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

_TABLE = Path(__file__).with_name("zoo-cases.yaml")
UNLISTED_FILES: Mapping[str, Path] = {
    "unlisted": Path(__file__).with_name("unlisted_effects.py"),
    "unlisted_2": Path(__file__).with_name("unlisted_effects_2.py"),
    "unlisted_3": Path(__file__).with_name("unlisted_effects_3.py"),
    "unlisted_4": Path(__file__).with_name("unlisted_effects_4.py"),
    "unlisted_5": Path(__file__).with_name("unlisted_effects_5.py"),
    "unlisted_6": Path(__file__).with_name("unlisted_effects_6.py"),
    "unlisted_7": Path(__file__).with_name("unlisted_effects_7.py"),
    "unlisted_8": Path(__file__).with_name("unlisted_effects_8.py"),
    "unlisted_9": Path(__file__).with_name("unlisted_effects_9.py"),
}
"""Where unlisted effects are, by what `use` calls the place."""


@dataclass(frozen=True)
class ZooCase:
    """One effect: its class and place as `levid trace` is to name them, and how it is simulated.

    `size` names the values that make it larger and the power of the scale that each goes with,
    such that forces or readings grow about in proportion: 1 for a gain, -1 for a distance or a
    stiffness. `absorbed` says by what, where a refit of the declared model leaves nothing of the
    effect. `alike` are classes that the same data fit as well. `sized` is whether its error can be
    chosen; what the drives alone feel leaves none in the gaps. `keys` are the names in the table of
    effects, or of groups in it, that are the mechanism itself; without any it is the class.
    `implied` are places that follow from another, as the torque of a force from its arm: to name
    one besides is neither right nor wrong. `unseen`: the tracer was never changed after what it
    said of this one.
    """

    name: str
    kind: str
    where: tuple[str, ...]
    use: str
    values: Mapping[str, Any]
    size: Mapping[str, float]
    absorbed: str | None
    alike: tuple[str, ...]
    sized: bool
    keys: tuple[str, ...]
    implied: tuple[str, ...]
    unseen: bool

    def effect(self, scale: float) -> dict[str, Any]:
        """Return the entry of a SIM.yaml's `effects` at `scale` times the nominal size."""
        values = dict(self.values)
        for key, power in self.size.items():
            by, value = scale**power, values[key]
            values[key] = [by * v for v in value] if isinstance(value, list) else by * value
        return {"use": self.use, **values}


def wherever(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return an entry by what its effect's file holds, where it has one, not by where that lies."""
    place, _, cls = str(entry["use"]).rpartition(":")
    if not place.endswith(".py"):
        return dict(entry)
    digest = hashlib.sha256(Path(place).read_bytes()).hexdigest()[:12]
    return {**entry, "use": f"{digest}:{cls}"}


def is_called(effect: str, key: str) -> bool:
    """Return whether an effect's name in the table is `key`, or one of the group `key`."""
    return effect == key or effect.startswith(f"{key}.")


def _read(section: str) -> tuple[ZooCase, ...]:
    table = yaml.safe_load(_TABLE.read_text(encoding="utf-8"))
    return tuple(_case(name, dict(row)) for name, row in table[section].items())


def _case(name: str, row: dict[str, Any]) -> ZooCase:
    place, _, cls = row.pop("use").rpartition(":")
    kind = row.pop("class")
    return ZooCase(
        name,
        kind,
        tuple(row.pop("where")),
        f"{UNLISTED_FILES.get(place, f'levid.sim.effects.{place}')}:{cls}",
        row.pop("values"),
        row.pop("size"),
        row.pop("absorbed", None),
        tuple(row.pop("alike", [])),
        row.pop("sized", True),
        tuple(row.pop("keys", [kind])),
        tuple(row.pop("implied", [])),
        row.pop("unseen", False),
    )


CASES = _read("cases")
"""Effects of levid.sim.effects."""

UNLISTED = _read("unlisted")
"""Effects that are in no table of levid's, candidates or simulator; see UNLISTED_FILES."""
