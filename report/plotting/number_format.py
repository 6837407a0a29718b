"""Format numbers, units, signals and locations for report pages."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from ...config.model import EffectParameter
from ...identification.subspace.response_uncertainty import SURE_95
from ...identification.value_with_interval import exponent_of, interval_decimals, told_from_zero
from .labelled_frequency_responses import symbol
from .style import engineering

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


def to_interval(value: float, half: float, digits: int = 2) -> str:
    """Return a value up to digit `digits` of half its 95 % interval, zeros at the end included.

    half, in the unit of the value; six digits without it (0 or infinite). Powers of ten as in
    `plain`.
    """
    if not (0.0 < half < np.inf and np.isfinite(value)):
        return plain(value)
    exponent = exponent_of(max(abs(value), half), 6)
    power = 0 if -4 <= exponent < 6 else exponent
    scale = 10.0**-power
    return _fixed(scale * value, interval_decimals(scale * half, digits)) + _times(power)


def interval(value: float, se: float) -> str:
    """Return 'value ± half of its 95 % interval', both to the second digit of the latter."""
    half = SURE_95 * se
    return _pair(value, half) if 0.0 < half < np.inf else f"{value:.4g}"


def with_interval(parameter: EffectParameter) -> str:
    """Return a value with its 95 % interval, such as '(3.003 ± 0.011)·10⁸ N/m³'."""
    value, unit = parameter.value, unit_text(parameter.unit)
    half = 0.0 if parameter.se is None else SURE_95 * parameter.se
    known = 0.0 < half < np.inf
    power = _power(max(abs(value), half) if known else abs(value))
    scale, times = 10.0**-power, _times(power)
    if not known:
        return f"{_minus(f'{scale * value:.6g}')}{times} {unit}".strip()
    inner = _pair(scale * value, scale * half)
    if times or unit:
        inner = f"({inner}){times}"
    return f"{inner} {unit}".strip()


def half_percent(value: float, se: float | None) -> str:
    """Return half of a value's 95 % interval in percent of the value; a dash if it is unknown, and
    words where 0 is inside."""
    if se is None or value == 0.0:
        return "—"
    if not told_from_zero(value, se):
        return "not told from 0"
    return f"{plain(100 * SURE_95 * se / abs(value), 2)} %"


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
        return f"{_minus(f'{value * 10.0**-power:.3g}')}{_times(power)} {plain}".strip()
    factor, prefix = engineering(abs(value), unit)
    return f"{_minus(f'{factor * value:.3g}')} {prefix}{plain}"


def share_text(share: float) -> str:
    """Return the explained share of the error at that time as text."""
    return f"{100 * share:.3g} % of the error above noise at that time"


def plain(value: float, digits: int = 6) -> str:
    """Return a number in SI units with `digits` digits, and powers of ten as in 1.5·10⁻⁷."""
    text = f"{value:.{digits}g}"
    head, _, exponent = text.partition("e")
    return _minus(head) + _times(int(exponent or 0))


def chance(p_value: float) -> str:
    """Return a probability with two digits, a bound for tiny ones, '—' for NaN."""
    if not np.isfinite(p_value):
        return "—"
    return (
        f"{p_value:.2f}" if p_value >= 0.01 else f"{p_value:.1g}" if p_value >= 1e-4 else "< 10⁻⁴"
    )


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


def _pair(value: float, half: float) -> str:
    digits = interval_decimals(half)
    return f"{_fixed(value, digits)} ± {_fixed(half, digits)}"


def _fixed(value: float, places: int) -> str:
    """Return a number rounded to this many decimals, which may be negative, and at most 12."""
    return _minus(f"{round(value, places):.{min(max(places, 0), 12)}f}")


def _times(power: int) -> str:
    return f"·10{str(power).translate(_SUPERSCRIPT)}" if power else ""


def _minus(text: str) -> str:
    return text.replace("-", "−")
