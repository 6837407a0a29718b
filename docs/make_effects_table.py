"""Writes docs/effects-table.md from the table of candidates: `python docs/make_effects_table.py`.

What a family is, where its equations come from and what it looks like is said by the docstring of
its module. tests/docs/test_effects_table.py fails when the page is not what this would write.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np

from levid.config.base import load_yaml
from levid.config.model import ModelConfig
from levid.config.rig import RigConfig
from levid.config.shipped import shipped
from levid.model.effects.base import Effect, Places, Quantity
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.flexible import PATTERNS
from levid.model.effects.relative_gains import relative_gains
from levid.model.geometry import shape_matrix

Row = tuple[str, str, str]
"""Key without its numbers, equation, what absorbs it."""
ACTUATOR = "each actuator"
"""Location of an actuator of a plant that is not the rig."""
PAGE = Path(__file__).with_name("effects-table.md")
HEAD = """# The table of candidate effects

The effects that `levid trace` tries: what a plant may do and its declared model may lack.
`docs/make_effects_table.py` generates this page from `model/effects/`.

- **Equations.** `force` at a DOF is added to the generalised force on it. `force` at a coil or
  actuator is its actual force; F is its command. `reading` is a sensor's reading; h is the
  platform's height at that sensor. `drive force` is added to the force of the beam's drives.
  Heights and pose are zero at the working point.
- **Absorbed by** names the parameters or constants of the declared model that can imitate the
  effect, or the named part of it. No data can reveal what they imitate.
- **Told apart by** names the excitation that separates an effect from similar ones. Effects that
  fit a session about equally well are reported together.
- **At** is `q` and *each actuator* for any plant that is not the rig: `q` is each DOF, and an
  actuator has the name of its input; *q and q2* is each pair of DOF. Units there are those of a
  DOF in m and a command in N. Laws of stiffness, damping, friction and backlash also act on each
  relative motion that a spring or damper of the model sees, as *q - q2*. Its sensors have the
  effects `reading.*`, at their DOF; those at a sensor are the rig's.
- **Numbers in brackets** at the end of a name are of the records: the mean position q_m and command
  F_m around which the equation is written, or the RMS speed or deflection at which it gives the
  force. Other records give other numbers, and the same law.
- **Non-rigid part** of the readings: the part that no motion of a rigid platform can produce.
"""


def main() -> None:
    """Write the page anew."""
    PAGE.write_text(page(), encoding="utf-8")


def page() -> str:
    """Return the page: a section for each family, on the rig and then on any other plant."""
    families: dict[str, dict[Row, list[Effect]]] = {}
    places = rig_places()
    for effect in (*all_effects(places), *relative_gains(places)):
        rows = families.setdefault(_module(effect).__name__, {})
        rows.setdefault(_row_of(effect), []).append(effect)
    others = all_effects(one_dof("m", "N"))
    two = two_dof(), two_dof("m", "rad"), two_dof("rad", "rad")
    for more in (one_dof("rad", "N m"), *two):
        known_keys = {e.key for e in others}
        others += tuple(e for e in all_effects(more) if e.key not in known_keys)
    for effect in others:
        rows = families.setdefault(_module(effect).__name__, {})
        # What the rig knows too is told as it is there.
        known = next((row for row in rows if row[0] == _row_of(effect)[0]), _row_of(effect))
        rows.setdefault(known, []).append(effect)
    sections = [_section(sys.modules[name], rows) for name, rows in families.items()]
    return "\n".join([HEAD, *sections])


def rig_places() -> Places:
    """Return where the shipped rig can be acted on and looked at."""
    geometry = load_yaml(shipped("rigs/loopback.yaml"), RigConfig).geometry
    model = load_yaml(shipped("models/rig.yaml"), ModelConfig)
    coils = np.array([geometry.coil_x_m, geometry.coil_y_m])
    sensors = np.array([geometry.sensors_x_m, geometry.sensors_y_m])
    return Places(
        tuple(q.name for q in model.dof),
        tuple(q.unit for q in model.dof),
        shape_matrix(*coils),
        shape_matrix(*sensors),
        "N",
        tuple(q.unit for q in model.inputs),
        "m",
        coils.T,
        sensors.T,
        beam=True,
    )


def one_dof(unit: str, force: str) -> Places:
    """Return a plant of which nothing is known but one input and one output."""
    one, nowhere = np.eye(1), np.zeros((0, 2))
    return Places(
        ("q",), (unit,), one, one, force, (force,), unit, nowhere, nowhere, beam=False,
        input_names=(ACTUATOR,),
    )  # fmt: skip


def two_dof(*units: str) -> Places:
    """Return the same with two inputs and two outputs, of some units."""
    units = units or ("m", "m")
    two, nowhere = np.eye(2), np.zeros((0, 2))
    commands = tuple("N m" if unit == "rad" else "N" for unit in units)
    return Places(
        ("q", "q2"), units, two, two, "N", commands, "m", nowhere, nowhere, beam=False,
        input_names=(ACTUATOR, "another one"),
    )  # fmt: skip


def _row_of(effect: Effect) -> Row:
    """Return what effects of one row of the page have in common."""
    # A law of a power states the number in its brackets in its equation too.
    equation = re.sub(r", ([vd]) = \S+ \S+$", "", effect.equation)
    return _general(effect.key), equation, effect.absorbed_by


def _section(module: ModuleType, rows: Mapping[Row, Sequence[Effect]]) -> str:
    title, _, rest = inspect.cleandoc(module.__doc__ or "").partition("\n\n")
    title = title.replace("\n", " ").rstrip(".")
    lines = [
        _row("effect", "class", "at", "equation", "parameters", "absorbed by", "told apart by")
    ]
    lines.append(_row(*["---"] * 7))
    for (key, equation, absorbed_by), same in rows.items():
        first = same[0]
        where = "; ".join(dict.fromkeys(_place(e) for e in same))
        quantities = ", ".join(
            _quantity(q, same) for q in (*first.amplitudes, *first.shape) if q.name not in PATTERNS
        )
        if any(q.name in PATTERNS for q in (*first.amplitudes, *first.shape)):
            quantities += ", and one share [1] for each other pattern"
        lines.append(
            _row(
                f"`{key}`", f"`{first.effect_class}`", where, _code(equation), quantities,
                absorbed_by or "—", first.told_apart_by or "—",
            )
        )  # fmt: skip
    return f"## {title}\n\n{rest}\n\n" + "\n".join(lines) + "\n"


def _module(effect: Effect) -> ModuleType:
    build = effect.build.func if isinstance(effect.build, partial) else effect.build
    module = inspect.getmodule(build)
    assert module is not None
    return module


_BRACKETS = {"permanent_magnet": "q_m", "damping": "v", "stiffness": "d", "actuator": "F_m"}
"""The number in brackets of a key, by the key's first part."""


def _general(key: str) -> str:
    """Return a key without the numbers or the pattern of a mode in it."""
    if key.endswith("]"):
        name, _, numbers = key.partition("[")
        return f"{name}[{'q_m,F_m' if ',' in numbers else _BRACKETS[name.partition('.')[0]]}]"
    head, _, tail = key.rpartition(".")
    if tail in PATTERNS:
        return f"{head}.PATTERN"
    return f"{head}.FREQUENCY" if tail.endswith("hz") else key


def _place(effect: Effect) -> str:
    """Return where an effect sits, any coil and any sensor being like the others."""
    kinds = [w.partition(":")[0] for w in effect.where]
    numbered = [w for w in effect.where if ":" in w]
    if len(numbered) > 2:
        return f"all {kinds[0]}s"
    if len(numbered) == 2:
        return f"two {kinds[0]}s"
    if numbered:
        return f"each {kinds[0]}"
    return " and ".join(effect.where) or "the platform"


def _quantity(quantity: Quantity, same: Sequence[Effect]) -> str:
    units = dict.fromkeys(
        q.unit for e in same for q in (*e.amplitudes, *e.shape) if q.name == quantity.name
    )
    return f"{quantity.name} [{'; '.join(units)}]"


def _code(equation: str) -> str:
    return "`" + equation.replace("|", "\\|") + "`"


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
