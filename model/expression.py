"""Arithmetic expressions of a declared model, checked when read and evaluated without `eval`."""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_BINARY: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "sqrt": np.sqrt,
    "sin": np.sin,
    "cos": np.cos,
    "exp": np.exp,
}
_DEEPEST = 50


class ExpressionError(ValueError):
    """An expression that is no arithmetic, or names what is not declared."""


@dataclass(frozen=True)
class Expression:
    """A formula such as `J_theta + m_b*(z_b**2 + x_b**2)` and the names it uses."""

    text: str
    names: frozenset[str]
    _tree: ast.expr

    @classmethod
    def parse(cls, source: str | float) -> Expression:
        """Parse numbers, names, + - * / **, sqrt, sin, cos, exp; raises ExpressionError."""
        text = str(source).strip()
        try:
            tree = ast.parse(text, mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            raise ExpressionError(f"expected an arithmetic expression, found '{text}'") from None
        names: set[str] = set()
        _check(tree, names, text, 0)
        return cls(text, frozenset(names), tree)

    def __call__(self, values: Mapping[str, float]) -> float:
        """Return the value in SI units; raises ExpressionError where it has none."""
        return float(self.over(values))

    def over(self, values: Mapping[str, Any]) -> NDArray[np.float64]:
        """Return the values where some of `values` are arrays (N,); raises ExpressionError."""
        try:
            with np.errstate(all="raise", under="ignore"):
                return np.asarray(_value(self._tree, values), np.float64)
        except (ArithmeticError, ValueError, TypeError) as error:
            raise ExpressionError(f"'{self.text}' has no value: {error}") from None


def _check(node: ast.expr, names: set[str], text: str, depth: int) -> None:
    if depth > _DEEPEST:
        raise ExpressionError(f"expected at most {_DEEPEST} levels of brackets, found '{text}'")
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return
        case ast.Name(id=name):
            names.add(name)
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            _check(operand, names, text, depth + 1)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            _check(left, names, text, depth + 1)
            _check(right, names, text, depth + 1)
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in _FUNCTIONS:
            _check(argument, names, text, depth + 1)
        case _:
            part = ast.unparse(node)
            raise ExpressionError(
                f"expected numbers, names, + - * / ** and {', '.join(_FUNCTIONS)}, "
                f"found '{part}' in '{text}'"
            )


def _value(node: ast.expr, values: Mapping[str, Any]) -> Any:
    match node:
        case ast.Constant(value=number):
            return float(number)  # type: ignore[arg-type]
        case ast.Name(id=name):
            try:
                return values[name]
            except KeyError:
                raise ValueError(f"'{name}' is not declared") from None
        case ast.UnaryOp(op=op, operand=operand):
            value = _value(operand, values)
            return -value if isinstance(op, ast.USub) else value
        case ast.BinOp(left=left, op=op, right=right):
            return _BINARY[type(op)](_value(left, values), _value(right, values))
        case ast.Call(func=ast.Name(id=name), args=[argument]):
            return _FUNCTIONS[name](_value(argument, values))
    raise AssertionError(node)
