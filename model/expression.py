"""Parse and evaluate arithmetic expressions of a declared model without `eval`."""

from __future__ import annotations

import ast
import math
import operator
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


def _power(base: Any, exponent: Any) -> Any:
    """Return base ** exponent; raise ArithmeticError where the result would be complex."""
    value = operator.pow(base, exponent)
    if np.iscomplexobj(value):
        raise ArithmeticError("a negative base needs an integer exponent")
    return value


_BINARY: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: _power,
}
_FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "sqrt": np.sqrt,
    "sin": np.sin,
    "cos": np.cos,
    "exp": np.exp,
}
_DECIMAL = re.compile(r"([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
"""Python also reads 0x20 and 1_000, which YAML reads in other ways or as text."""
_DEEPEST = 50
_MOST_CHARACTERS = 4000
"""Longest expression; a sum has no other limit."""
_SHOWN = 60


class ExpressionError(ValueError):
    """An expression is not arithmetic, uses an undeclared name, or has no finite value."""


@dataclass(frozen=True)
class Expression:
    """A formula such as `J_theta + m_b*(z_b**2 + x_b**2)` and the names it uses."""

    text: str
    names: frozenset[str]
    _tree: ast.expr

    @classmethod
    def parse(cls, source: str | float) -> Expression:
        """Parse finite numbers, names, + - * / **, sqrt, sin, cos, exp; raises ExpressionError."""
        if isinstance(source, float) and not math.isfinite(source):
            raise ExpressionError(f"expected a finite number, found {source}")
        if isinstance(source, int) and not _is_finite(source):
            raise ExpressionError("expected a finite number, found a too large one")
        text = str(source).strip()
        if len(text) > _MOST_CHARACTERS:
            raise ExpressionError(
                f"expected an expression of at most {_MOST_CHARACTERS} characters, found "
                f"{len(text)}"
            )
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Python's, of what it reads in another way
                tree = ast.parse(text, mode="eval").body
        except (RecursionError, MemoryError):
            raise ExpressionError(_too_deep(text)) from None
        except (SyntaxError, ValueError):
            raise ExpressionError(
                f"expected an arithmetic expression, found '{_short(text)}'"
            ) from None
        names: set[str] = set()
        _check(tree, names, text, 0)
        return cls(text, frozenset(names), tree)

    def __call__(self, values: Mapping[str, float]) -> float:
        """Return the value in SI units; raises ExpressionError if it is not a finite number."""
        return float(self.over(values))

    def over(self, values: Mapping[str, Any]) -> NDArray[np.float64]:
        """Return the values (N,), or a scalar, for `values` that may be arrays (N,).

        Raises:
            ExpressionError: an undeclared name, or a value that is not real and finite.
        """
        if isinstance(self._tree, ast.Constant):  # finite, as most entries of most matrices
            return np.asarray(self._tree.value, np.float64)
        try:
            with np.errstate(all="raise", under="ignore"):
                found = np.asarray(_value(self._tree, values), np.float64)
        except OverflowError:
            raise ExpressionError(
                f"'{_short(self.text)}' has no value: the result is too large"
            ) from None
        except (ArithmeticError, ValueError, TypeError) as error:
            raise ExpressionError(f"'{_short(self.text)}' has no value: {error}") from None
        if not np.all(np.isfinite(found)):
            raise ExpressionError(
                f"'{_short(self.text)}' has no value: expected finite numbers, found "
                f"{found.flat[int(np.argmin(np.isfinite(found)))]:g}"
            )
        return found


def _check(node: ast.expr, names: set[str], text: str, depth: int) -> None:
    if depth > _DEEPEST:
        raise ExpressionError(_too_deep(text))
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            if not _is_finite(number):
                raise ExpressionError(
                    f"expected finite numbers, found a too large one in '{_short(text)}'"
                )
            written = ast.get_source_segment(text, node) or ""
            if not _DECIMAL.fullmatch(written):
                raise ExpressionError(
                    f"expected decimal numbers, found '{_short(written)}' in '{_short(text)}'"
                )
        case ast.Name(id=name):
            names.add(name)
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            _check(operand, names, text, depth + 1)
        case ast.BinOp(op=op) if type(op) in _BINARY:
            first, terms = _terms(node)
            for part in (first, *(right for _, right in terms)):
                _check(part, names, text, depth + 1)
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in _FUNCTIONS:
            _check(argument, names, text, depth + 1)
        case _:
            segment = ast.get_source_segment(text, node) or text
            raise ExpressionError(
                f"expected numbers, names, + - * / ** and {', '.join(_FUNCTIONS)}, "
                f"found '{_short(segment)}' in '{_short(text)}'"
            )


def _terms(node: ast.expr) -> tuple[ast.expr, list[tuple[ast.operator, ast.expr]]]:
    """Return the first term, and operator and term of each further one: a sum may be long."""
    terms: list[tuple[ast.operator, ast.expr]] = []
    while isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        terms.append((node.op, node.right))
        node = node.left
    return node, terms[::-1]


def _too_deep(text: str) -> str:
    return f"expected at most {_DEEPEST} levels of brackets and powers, found '{_short(text)}'"


def _is_finite(number: int | float) -> bool:
    try:
        return math.isfinite(float(number))
    except OverflowError:
        return False


def _short(text: str) -> str:
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


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
        case ast.BinOp():
            first, terms = _terms(node)
            result = _value(first, values)
            for operation, right in terms:
                result = _BINARY[type(operation)](result, _value(right, values))
            return result
        case ast.Call(func=ast.Name(id=name), args=[argument]):
            return _FUNCTIONS[name](_value(argument, values))
    raise AssertionError(node)
