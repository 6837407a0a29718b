"""Test docs/effects.md: its examples run, and its tables are complete."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re

import numpy as np
import pytest
from repository_folders import DOCS

from levid.config.base import load_yaml
from levid.config.shipped import shipped
from levid.config.sim import SimConfig
from levid.sim import effects
from levid.sim.effects import HOOKS
from levid.sim.plant import Plant

DOC = (DOCS / "effects.md").read_text()
(CODE,) = re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)
SNIPPET, SHIPPED = re.findall(r"```yaml\n(.*?)```", DOC, re.DOTALL)


@pytest.fixture
def plant(tmp_path):
    nominal = shipped("sims/nominal.yaml").read_text()
    assert nominal.endswith("effects: []\n")  # the page expects this ending
    (tmp_path / "warm.py").write_text(CODE)
    path = tmp_path / "my-sim.yaml"
    path.write_text(nominal.replace("effects: []\n", SNIPPET))
    return Plant(load_yaml(path, SimConfig), 1e-3, source=path)


def test_example_changes_the_motion_and_not_the_coil_readback(plant):
    nominal = Plant(load_yaml(shipped("sims/nominal.yaml"), SimConfig), 1e-3)
    coil_n = np.full(9, 7.0)  # 63 N for a weight of 69 N: the platform stays on its lower stops
    for _ in range(100):
        for p in (plant, nominal):
            p.advance(coil_n, np.zeros(3), np.zeros(3))
            p.sample()
    assert not np.array_equal(plant.pose, nominal.pose)
    np.testing.assert_array_equal(plant.coil_readback_n, nominal.coil_readback_n)


def test_floor_vibration_of_the_example_moves_the_platform(plant):
    coil_n, z = np.full(9, 7.0), []
    for _ in range(2 * 1000):
        plant.advance(coil_n, np.zeros(3), np.zeros(3))
        z.append(plant.pose[2])
    spectrum = np.abs(np.fft.rfft(np.array(z[1000:]) - np.mean(z[1000:])))
    assert np.argmax(spectrum) == 17  # Hz, the line spacing of one second


def test_coil_of_the_example_warms_up(tmp_path):
    names = {}
    exec(compile(CODE, "warm.py", "exec"), names)
    coil = names["WarmCoil"](coil=4, loss=0.05, time_constant_s=60, rated_n=10)

    class FakePlant:
        dt_s = 1.0

    coil.reset(FakePlant)
    for _ in range(600):  # ten time constants at the rated force: steady state to 5e-5
        force_n = coil.coil_force(0.0, np.zeros(3), np.full(9, 10.0))
    np.testing.assert_allclose(force_n, [10.0] * 4 + [9.5] + [10.0] * 4, rtol=1e-4)


def test_page_lists_every_hook():
    table = re.findall(r"^\| `(\w+)\(", DOC, re.MULTILINE)
    assert tuple(table) == HOOKS


def test_page_lists_every_shipped_effect_with_its_keys():
    listed = dict(re.findall(r"^\| `(\w+:\w+)` \| (.*?) \|", DOC, re.MULTILINE))
    shipped_effects = {}
    for module in pkgutil.iter_modules(effects.__path__):
        name = f"{effects.__name__}.{module.name}"
        for cls in vars(importlib.import_module(name)).values():
            hooked = inspect.isclass(cls) and any(hasattr(cls, hook) for hook in HOOKS)
            if (
                hooked
                and cls.__module__ == name
                and module.name not in ("effect_interface", "loader")
            ):
                shipped_effects[f"{module.name}:{cls.__name__}"] = cls
    bases = {base for cls in shipped_effects.values() for base in cls.__mro__[1:]}
    keys = {use: _keys(cls) for use, cls in shipped_effects.items() if cls not in bases}
    assert listed == keys


def _keys(cls):
    """Return the keyword arguments of the class in the page's format."""
    shown = []
    for key, parameter in inspect.signature(cls).parameters.items():
        default = parameter.default
        has_value = default is not parameter.empty and default is not None
        value = default if isinstance(default, str) or not has_value else f"{default:g}"
        shown.append(f"`{key}={value}`" if has_value else f"`{key}`")
    return ", ".join(shown)


def test_shipped_effects_of_the_page_fly(tmp_path):
    nominal = shipped("sims/nominal.yaml").read_text()
    path = tmp_path / "my-sim.yaml"
    path.write_text(nominal.replace("effects: []\n", SHIPPED))
    plant = Plant(load_yaml(path, SimConfig), 1e-3, source=path)
    for _ in range(20):
        plant.advance(np.full(9, 8.0), np.zeros(3), np.zeros(3))
    assert np.isfinite(plant.pose).all()
