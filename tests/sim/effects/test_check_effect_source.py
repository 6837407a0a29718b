"""Test the check of effects in Python files that must not run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from levid.config.sim import SimEffect
from levid.sim.effects.check_effect_source import check_effects
from levid.sim.effects.effect_interface import EffectError

RUNS = """
import sys
from pathlib import Path
Path(__file__).with_suffix(".ran").touch()
sys.exit(0)
"""
CLASSES = (
    RUNS
    + """
from dataclasses import dataclass, field
from elsewhere import Imported

class Push:
    def __init__(self, size_n, *, at_s=0.0):
        self.size_n = size_n
    def wrench(self, t_s, q, qd, beam):
        return [0.0, 0.0, self.size_n]

@dataclass
class Data:
    size_n: float
    at_s: float = 0.0
    def mass(self, t_s):
        return 0.0

class Any:
    def __init__(self, **values): ...
    def gap(self, t_s, gap_m): return gap_m

class Bound:
    gap = staticmethod(lambda t_s, gap_m: gap_m)

class Derived(Push): ...
class Empty: ...
Made = type("Made", (Push,), {})
"""
)


def check(tmp_path: Path, text: str, name: str, **values: Any) -> list[Path]:
    (tmp_path / "own.py").write_text(text)
    effect = SimEffect.model_validate({"use": f"own.py:{name}", **values})
    try:
        return check_effects([effect], tmp_path / "sim.yaml")
    finally:
        assert not (tmp_path / "own.ran").exists()


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("Push", {"size_n": 1.0}),
        ("Push", {"size_n": 1.0, "at_s": 2.0}),
        ("Data", {"size_n": 1.0}),
        ("Any", {"whatever": 1}),
        ("Bound", {}),
        ("Derived", {"size_n": 1.0}),
        ("Imported", {}),
        ("Made", {}),
    ],
)
def test_a_class_that_may_be_an_effect_passes(tmp_path: Path, name: str, values: Any) -> None:
    assert check(tmp_path, CLASSES, name, **values) == [tmp_path / "own.py"]


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("Nobody", {}, "own.py has no class 'Nobody'; its classes: Push, Data, Any, Bound"),
        ("Empty", {}, "expected a class with one or more of"),
        ("Push", {}, "the values do not fit the class: missing size_n"),
        ("Push", {"size_n": 1, "sise": 2}, "the values do not fit the class: unknown sise"),
        ("Data", {"at_s": 1.0}, "the values do not fit the class: missing size_n"),
        ("Bound", {"size": 1.0}, "the values do not fit the class: unknown size"),
    ],
)
def test_what_cannot_be_an_effect_is_an_error(
    tmp_path: Path, name: str, values: Any, said: str
) -> None:
    with pytest.raises(EffectError, match=r"sim\.yaml: effects\[0\] \(own\.py:") as caught:
        check(tmp_path, CLASSES, name, **values)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("class A(:\n", "line 1: "),
        ("x = '\0'", "own.py: "),
        ("#" * (1 << 21), "expected a Python file of at most 1024 KiB"),
        ("(" * 5000, "own.py: "),
    ],
)
def test_what_is_no_python_is_an_error(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(EffectError) as caught:
        check(tmp_path, text, "A")
    assert said in str(caught.value)


def test_packages_are_looked_for_but_not_imported(tmp_path: Path) -> None:
    (tmp_path / "sim.yaml").touch()
    missing = SimEffect(use="no_such_package.effects:Push")
    with pytest.raises(EffectError, match=r"cannot import no_such_package\.effects"):
        check_effects([missing], tmp_path / "sim.yaml")
    assert not check_effects([SimEffect(use="antigravity:Flight")], tmp_path / "sim.yaml")
    own = SimEffect(use="levid.sim.effects.ground_vibration:Nothing")
    with pytest.raises(EffectError, match="has no class 'Nothing'"):
        check_effects([own], tmp_path / "sim.yaml")
