"""Load the effects of a SIM.yaml, call their hooks in order and check the results."""

from __future__ import annotations

import errno
import hashlib
import importlib
import importlib.util
import inspect
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ...config.runtime.private_files import ForeignFileError, read_code
from ...config.sim import SimEffect, SimGeometry
from ..plant_kernels import Array
from .effect_interface import HOOKS, BeamState, EffectError, EffectGeometry, EffectPlant

_RENAMED = {
    f"levid.sim.effects.floor:Floor{kind}": f"levid.sim.effects.ground_vibration:Ground{kind}"
    for kind in ("Tone", "Noise")
}
"""Classes under the names that SIM.yaml files of earlier versions use."""


class Effects:
    """The effects of one plant, called in order.

    Raises (constructor and every method):
        EffectError: a class is missing or does not accept the given values; a hook raises, or
            returns a wrong shape or numbers that are not finite. The message names the SIM.yaml.
    """

    def __init__(self, effects: Sequence[SimEffect], source: Path | None) -> None:
        self.source = str(source or "SIM.yaml")
        self._loaded = [
            _Loaded(effect_place(self.source, i, effect), effect, source)
            for i, effect in enumerate(effects)
        ]
        self._with = {
            hook: [effect for effect in self._loaded if hook in effect.hooks] for hook in HOOKS
        }

    def __bool__(self) -> bool:
        return bool(self._loaded)

    def uses(self, hook: str) -> bool:
        """Return whether any effect has this hook."""
        return bool(self._with[hook])

    def reset(
        self,
        dt_s: float,
        rngs: Sequence[np.random.Generator],
        geometry: SimGeometry,
        beam_z_m: float,
    ) -> None:
        """Call `reset` of every effect with the plant's data; `rngs` has a generator for each."""
        for effect, rng in zip(self._loaded, rngs, strict=True):
            if "reset" in effect.hooks:
                own = EffectGeometry(
                    geometry.r_m,
                    np.array(geometry.coil_x_m),
                    np.array(geometry.coil_y_m),
                    beam_z_m,
                    np.array(geometry.sensor_x),
                    np.array(geometry.sensor_y),
                )
                effect.call("reset", EffectPlant(dt_s, rng, own))

    def coil_force(self, t_s: float, q: Array, force_n: Array) -> Array:
        """Return the true coil forces (C,) in N."""
        for effect in self._with["coil_force"]:
            force_n = effect.array("coil_force", force_n.shape, t_s, q.copy(), force_n.copy())
        return force_n

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Array:
        """Return the sum of the external wrenches (3,) in N m, N m, N."""
        total = np.zeros(3)
        for effect in self._with["wrench"]:
            total += effect.array("wrench", (3,), t_s, q.copy(), qd.copy(), beam)
        return total

    def mass(self, t_s: float) -> Array:
        """Return the sum (3, 3) that is added to the mass matrix."""
        total = np.zeros((3, 3))
        for effect in self._with["mass"]:
            added = effect.array("mass", (3, 3), t_s)
            asymmetry = abs(added[0, 1] - added[1, 0]) + abs(added[0, 2] - added[2, 0])
            asymmetry += abs(added[1, 2] - added[2, 1])
            if asymmetry > 0.0 and asymmetry > 1e-9 * np.abs(added).max():
                raise EffectError(
                    f"{effect.where}: mass: expected a symmetric matrix, found {added.tolist()}"
                )
            total += added
        return total

    def beam_force(self, t_s: float, beam: BeamState, q: Array, qd: Array) -> float:
        """Return the sum of the forces on the beam along x, N."""
        total = 0.0
        for effect in self._with["beam_force"]:
            total += float(effect.array("beam_force", (), t_s, beam, q.copy(), qd.copy()))
        return total

    def gap(self, t_s: float, gap_m: Array) -> Array:
        """Return the gaps as the sensors measure them (S,) in m."""
        for effect in self._with["gap"]:
            gap_m = effect.array("gap", gap_m.shape, t_s, gap_m.copy())
        return gap_m


def effect_place(source: Path | str | None, i: int, effect: SimEffect) -> str:
    """Return how messages name an effect of SIM.yaml."""
    return f"{source or 'SIM.yaml'}: effects[{i}] ({effect.use})"


class _Loaded:
    """One effect: its instance, its hooks, and its name in errors."""

    def __init__(self, where: str, effect: SimEffect, source: Path | None) -> None:
        self.where = where
        cls = _find_class(where, effect.use, source)
        # Before its constructor runs: SIM.yaml may name any class, one that starts programs too.
        if not any(callable(getattr(cls, hook, None)) for hook in HOOKS):
            raise EffectError(
                f"{where}: expected a class with one or more of {', '.join(HOOKS)}, found none"
            )
        try:
            inspect.signature(cls).bind(**effect.values)
        except TypeError as error:
            raise EffectError(f"{where}: the values do not fit the class: {error}") from None
        except ValueError:
            pass  # the class has no signature: its call raises if the values do not fit
        self.hooks: dict[str, Callable[..., Any]] = {}
        try:
            instance = cls(**effect.values)
        except Exception as error:
            raise EffectError(f"{where}: {type(error).__name__}: {error}") from error
        for hook in HOOKS:
            method = getattr(instance, hook, None)
            if callable(method):
                self.hooks[hook] = method

    def call(self, hook: str, *arguments: object) -> object:
        try:
            return self.hooks[hook](*arguments)
        except Exception as error:
            raise EffectError(
                f"{self.where}: {hook} raised {type(error).__name__}: {error}"
            ) from error

    def array(self, hook: str, shape: tuple[int, ...], *arguments: object) -> Array:
        """Call a hook and return its result (shape) as a new float64 array."""
        answer = self.call(hook, *arguments)
        try:
            array = np.array(answer, dtype=np.float64)
        except (TypeError, ValueError):
            raise EffectError(
                f"{self.where}: {hook}: expected numbers of shape {shape}, found {answer!r:.60}"
            ) from None
        if answer is None or array.shape != shape:
            found = "None" if answer is None else f"shape {array.shape}"
            raise EffectError(f"{self.where}: {hook}: expected shape {shape}, found {found}")
        # For three to nine numbers Python's sum takes a third of numpy's time.
        if not (math.isfinite(sum(array.ravel().tolist())) or np.isfinite(array).all()):
            raise EffectError(
                f"{self.where}: {hook}: expected finite numbers, found {array} "
                f"at t_s, ... = {arguments[0]!r}"
            )
        return array


class _CheckedSource(SourceFileLoader):
    """Load a Python file that no other user can change, without the bytecode beside it."""

    def path_stats(self, path: str) -> Mapping[str, Any]:
        """Raise OSError, so that bytecode is neither read nor written."""
        raise OSError(errno.ENOTSUP, "bytecode is not used", path)

    def get_data(self, path: str) -> bytes:
        """Return the source; raises ForeignFileError."""
        return read_code(path)


def _find_class(where: str, use: str, source: Path | None) -> Callable[..., object]:
    place, _, name = _RENAMED.get(use, use).rpartition(":")
    module = _load_file(where, place, source) if place.endswith(".py") else _load(where, place)
    found = getattr(module, name, None)
    if not inspect.isclass(found):
        classes = [key for key, value in vars(module).items() if inspect.isclass(value)]
        known = ", ".join(classes) or "none"
        raise EffectError(f"{where}: {place} has no class '{name}'; its classes: {known}")
    return found


def _load(where: str, name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except Exception as error:
        raise EffectError(
            f"{where}: cannot import {name}: {type(error).__name__}: {error}"
        ) from error


def effect_file(where: str, place: str, source: Path | None) -> Path:
    """Return the Python file that `use:` names, beside SIM.yaml or in the current folder.

    Raises:
        EffectError: there is no such file.
    """
    folders = ([source.parent] if source is not None else []) + [Path.cwd()]
    tried = [(folder / Path(place).expanduser()).resolve() for folder in folders]
    path = next((p for p in tried if p.is_file()), None)
    if path is None:
        paths = " or ".join(map(str, dict.fromkeys(tried)))
        raise EffectError(f"{where}: expected a Python file, found no file {paths}")
    return path


def _load_file(where: str, place: str, source: Path | None) -> ModuleType:
    path = effect_file(where, place, source)
    name = f"levid_effect_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}"
    loader = _CheckedSource(name, str(path))
    spec = importlib.util.spec_from_file_location(name, path, loader=loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and pickle find a module by its name
    try:
        loader.exec_module(module)
    except ForeignFileError as error:
        del sys.modules[name]
        raise EffectError(f"{where}: {path}: {error.strerror}") from None
    except Exception as error:
        del sys.modules[name]
        raise EffectError(f"{where}: {path}: {type(error).__name__}: {error}") from error
    return module
