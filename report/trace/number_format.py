"""Format numbers, units, signals and locations for the trace report."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from ...config.model import EffectParameter
from ...identification.value_with_interval import interval_decimals
from ..plotting.labelled_frequency_responses import symbol
from ..plotting.style import engineering

CONFIDENCE = 1.96
"""95 % of Gaussian errors are within this many standard deviations."""
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def unit_text(unit: str) -> str:
    """Return a unit with superscript powers, '' for none."""
    if unit in ("", "1"):
        return ""
    return re.sub(r"\^(-?\d+)", lambda m: m[1].translate(_SUPERSCRIPT), unit)


def signal_text(name: str) -> str:
    """Return a signal's name with Greek letters, such as θ′ for theta'; others unchanged."""
    base = name.rstrip("'")
    known = symbol(base) if "_b" not in base else base
    return known + ("", "′", "″")[len(name) - len(base)]


def place_text(place: str, dof: Sequence[str]) -> str:
    """Return a location with its DOF in Greek letters, such as 'force on θ'."""
    head, _, last = place.rpartition(" ")
    return f"{head} {symbol(last)}".strip() if last in dof else place


def with_interval(parameter: EffectParameter) -> str:
    """Return a value with its 95 % interval, such as '(3.003 ± 0.011)·10⁸ N/m³'."""
    value, unit = parameter.value, unit_text(parameter.unit)
    half = None if parameter.se is None else CONFIDENCE * parameter.se
    power = _power(max(abs(value), half or 0.0))
    scale = 10.0**-power
    times = f"·10{str(power).translate(_SUPERSCRIPT)}" if power else ""
    if half is None or not half > 0:
        return f"{_minus(f'{scale * value:.6g}')}{times} {unit}".strip()
    digits = min(max(interval_decimals(scale * half), 0), 12)
    inner = f"{_minus(f'{scale * value:.{digits}f}')} ± {scale * half:.{digits}f}"
    if times or unit:
        inner = f"({inner}){times}"
    return f"{inner} {unit}".strip()


def amount(value: float, unit: str) -> str:
    """Return a value with three digits and a prefix, such as '1.36 µm', or a power of ten."""
    plain = unit_text(unit)
    if not np.isfinite(value):
        return "—"
    if not plain or " " in plain or "/" in plain or value == 0:
        power = _power(abs(value)) if " " not in plain or "/" in plain else None
        if power is None:
            factor, prefix = engineering(abs(value), unit)
            return f"{_minus(f'{factor * value:.3g}')} {prefix}{plain}"
        times = f"·10{str(power).translate(_SUPERSCRIPT)}" if power else ""
        return f"{_minus(f'{value * 10.0**-power:.3g}')}{times} {plain}".strip()
    factor, prefix = engineering(abs(value), unit)
    return f"{_minus(f'{factor * value:.3g}')} {prefix}{plain}"


def share_text(share: float) -> str:
    """Return the explained share of the error at that time as text."""
    return f"{100 * share:.3g} % of the error above noise at that time"


def plain(value: float, digits: int = 6) -> str:
    """Return a number in SI units with `digits` digits, and powers of ten as in 1.5·10⁻⁷."""
    text = f"{value:.{digits}g}"
    head, _, exponent = text.partition("e")
    power = f"·10{str(int(exponent)).translate(_SUPERSCRIPT)}" if exponent else ""
    return _minus(head) + power


def significant(value: float, digits: int) -> str:
    """Return a number with exactly `digits` digits, zeros at the end too; large ones in full."""
    decimals = digits - 1 - int(np.floor(np.log10(abs(value)))) if value else 0
    if abs(value) < 1e-3:
        return plain(value, digits)
    return _minus(f"{value:.{min(max(decimals, 0), 12)}f}")


def times_text(ratio: float) -> str:
    """Return a multiple with three digits."""
    return f"{ratio:.3g}" if np.isfinite(ratio) else "—"


def change_text(before: float, after: float) -> str:
    """Return the change in percent with a typographic minus."""
    if not (before > 0 and np.isfinite(after)):
        return "—"
    change = 100 * (after / before - 1)
    return "0 %" if abs(change) < 0.05 else _minus(f"{change:+.1f} %")


def _power(size: float) -> int:
    """Return the power of ten of a number; 0 from 0.01 to 10 000."""
    if not (size > 0 and np.isfinite(size)):
        return 0
    exponent = int(np.floor(np.log10(size)))
    return 0 if -2 <= exponent < 4 else exponent


def _minus(text: str) -> str:
    return text.replace("-", "−")
