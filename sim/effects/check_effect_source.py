"""Check the effects of a SIM.yaml without running a line of a Python file that it names.

A file is parsed: the class, a hook, and the arguments of its constructor must be there. What only
running would tell, such as a class that is made by a call, is left to the simulator. Classes of the
package itself are constructed.
"""

from __future__ import annotations

import ast
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from ...config.runtime.private_files import ForeignFileError, read_code
from ...config.sim import SimEffect
from .effect_interface import HOOKS, EffectError
from .loader import Effects, effect_file, effect_place

_OWN = __name__.split(".")[0] + "."
_MOST_BYTES = 1 << 20
"""Largest Python file; the largest one of the package has 20 KiB."""


def check_effects(effects: Sequence[SimEffect], source: Path | None) -> list[Path]:
    """Check that effects can be loaded; return the Python files that were read, but not run.

    Raises:
        EffectError: a class is missing, has no hook, or does not accept the given values. A class
            of another installed package is looked for when the simulator starts.
    """
    Effects([e for e in effects if e.use.startswith(_OWN)], source)
    read = []
    for i, effect in enumerate(effects):
        place, _, name = effect.use.rpartition(":")
        if place.endswith(".py"):
            where = effect_place(source, i, effect)
            path = effect_file(where, place, source)
            _check(where, _parsed(where, path), name, place, effect)
            read.append(path)
        elif find_spec(place.split(".")[0]) is None:
            where = effect_place(source, i, effect)
            raise EffectError(f"{where}: cannot import {place}: no package of this name is there")
    return read


def _parsed(where: str, path: Path) -> ast.Module:
    try:
        text = read_code(path, _MOST_BYTES)
    except ForeignFileError as error:
        raise EffectError(f"{where}: {path}: {error.strerror}") from None
    except OSError as error:
        raise EffectError(f"{where}: {path} cannot be read: {error.strerror}") from None
    if len(text) > _MOST_BYTES:
        raise EffectError(
            f"{where}: expected a Python file of at most {_MOST_BYTES >> 10} KiB, found more"
        )
    try:
        return ast.parse(text, str(path))
    except SyntaxError as error:
        raise EffectError(f"{where}: {path}: line {error.lineno}: {error.msg}") from None
    except (ValueError, RecursionError, MemoryError) as error:
        raise EffectError(f"{where}: {path}: {type(error).__name__}: {error}") from None


def _check(where: str, tree: ast.Module, name: str, place: str, effect: SimEffect) -> None:
    classes = {node.name: node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
    if name not in classes:
        if name in _bound(tree):
            return
        known = ", ".join(classes) or "none"
        raise EffectError(f"{where}: {place} has no class '{name}'; its classes: {known}")
    made = classes[name]
    if made.bases or made.keywords:
        return  # hooks and constructor may be inherited
    methods = {node.name: node for node in made.body if isinstance(node, ast.FunctionDef)}
    if not set(methods) & set(HOOKS) and not _bound(made) & set(HOOKS):
        raise EffectError(
            f"{where}: expected a class with one or more of {', '.join(HOOKS)}, found none"
        )
    if made.decorator_list and not _is_dataclass(made):
        return
    accepted, required = _arguments(made, methods.get("__init__"))
    wrong = [] if accepted is None else sorted(set(effect.values) - accepted)
    missing = sorted(required - set(effect.values))
    if wrong or missing:
        said = [f"unknown {', '.join(wrong)}"] * bool(wrong)
        said += [f"missing {', '.join(missing)}"] * bool(missing)
        raise EffectError(f"{where}: the values do not fit the class: {'; '.join(said)}")


def _arguments(
    made: ast.ClassDef, init: ast.FunctionDef | None
) -> tuple[set[str] | None, set[str]]:
    """Return the names that a constructor accepts, None for any, and those that it needs."""
    if init is None:
        fields = [
            node
            for node in made.body
            if isinstance(node, ast.AnnAssign)
            and isinstance(node.target, ast.Name)
            and "ClassVar" not in ast.unparse(node.annotation)
        ]
        if not _is_dataclass(made):
            return set(), set()
        names = {ast.unparse(node.target) for node in fields}
        return names, {ast.unparse(node.target) for node in fields if node.value is None}
    own = init.args
    plain = [*own.posonlyargs, *own.args]
    needed = plain[1 : len(plain) - len(own.defaults)]
    needed += [a for a, default in zip(own.kwonlyargs, own.kw_defaults, strict=True) if not default]
    accepted = {a.arg for a in [*plain[1:], *own.kwonlyargs]}
    return (None if own.kwarg else accepted), {a.arg for a in needed}


def _is_dataclass(made: ast.ClassDef) -> bool:
    called = [d.func if isinstance(d, ast.Call) else d for d in made.decorator_list]
    return any(ast.unparse(d).split(".")[-1] == "dataclass" for d in called)


def _bound(node: ast.Module | ast.ClassDef) -> set[str]:
    """Return the names that imports and assignments of a body bind."""
    found = set[str]()
    for part in ast.walk(node):
        if isinstance(part, (ast.Import, ast.ImportFrom)):
            found |= {(alias.asname or alias.name).split(".")[0] for alias in part.names}
            if any(alias.name == "*" for alias in part.names):
                found |= {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
        elif isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
            found.add(part.id)
    return found
