"""Where a platform resonates as it bends: frequency and damping, read off the records.

What the sensors show beyond the rigid pose is held, pattern by pattern, against the command forces
in the same pattern: cross spectra over all records, and of those the resonance that explains most.
It is where a fit begins; a resonance that is narrower than the steps of a grid would be missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import fmin

from ....model.effects.flexible import PATTERNS, patterns
from .trace_record import TraceRecord

Array = NDArray[np.float64]

_SEGMENT_S = 4.0
_LOWEST_HZ, _HIGHEST = 12.0, 0.4
"""From above the platform's own loop up to a share of the rate of sampling."""
_STEP, _DAMPING = 0.015, 0.03
"""Ratio between frequencies that are tried first, and the damping at which neighbours overlap."""
_SURE = 50.0
"""Squared standard deviations by which a resonance must explain more than noise would: the best of
some thousand tried had 18 in flights without one."""
_MOST = 2
"""Resonances of one pattern."""
_BROAD = 0.3
"""A damping beyond which nothing resonates: the grid sees that anyway."""
_LOG_DAMPING = np.log([1e-3, 0.7])


class Resonance(NamedTuple):
    """A pattern of bending by its name, its frequency in Hz, and its damping ratio."""

    pattern: str
    frequency_hz: float
    damping: float


def resonances(records: Sequence[TraceRecord]) -> tuple[Resonance, ...]:
    """Return resonances of patterns that a rigid platform cannot show, to three digits.

    Those that explain most of a pattern come first. None where nobody knows where sensors and coils
    are; records of another rate than most rows have are left out.
    """
    names, over_sensors, over_coils = patterns(records[0].places)
    bends = [i for i, name in enumerate(names) if name in PATTERNS]
    found: list[Resonance] = []
    if bends:
        spectra = _spectra(records, over_sensors[:, bends], over_coils[:, bends])
        for i, one in zip(bends, spectra, strict=False):
            found += [
                Resonance(names[i], float(f"{f_hz:.3g}"), float(f"{zeta:.3g}"))
                for f_hz, zeta in _strongest(one)
            ]
    return tuple(found)


@dataclass(frozen=True)
class _Spectra:
    """Of one pattern, (F,): cross and own spectra of force u and reading y, means of `count`."""

    freq_hz: Array
    yu: NDArray[np.complex128]
    uu: Array
    yy: Array
    count: int

    def without(self, response: NDArray[np.complex128]) -> _Spectra:
        """Return the spectra with y freed of what a response (F,) makes of u."""
        gain = np.sum(response.conj() * self.yu) / np.sum(np.abs(response) ** 2 * self.uu)
        made = gain * response
        left = self.yy - 2 * (made.conj() * self.yu).real + np.abs(made) ** 2 * self.uu
        return replace(self, yu=self.yu - made * self.uu, yy=np.maximum(left, 0.0))


def _strongest(spectra: _Spectra) -> list[tuple[float, float]]:
    """Return frequencies and dampings of what stands out, one freed of the other."""
    if not spectra.uu.any():
        return []
    first, last = spectra.freq_hz[[0, -1]]
    tried = np.exp(np.arange(np.log(first), np.log(last), _STEP))
    found: list[tuple[float, float]] = []
    while len(found) < _MOST:
        explained = [_explained(spectra, f_hz, _DAMPING)[0] for f_hz in tried]
        f_hz, zeta = _fitted(spectra, float(tried[np.argmax(explained)]))
        if _explained(spectra, f_hz, zeta)[1] < _SURE or zeta > _BROAD:
            break
        found.append((f_hz, zeta))
        spectra = spectra.without(_response(spectra.freq_hz, f_hz, zeta))
    return found


def _spectra(
    records: Sequence[TraceRecord], over_sensors: Array, over_coils: Array
) -> list[_Spectra]:
    """Return the spectra of each pattern; over_sensors (S, P), over_coils (C, P)."""
    rows: dict[float, int] = {}
    for r in records:
        rows[r.experiment.Ts_s] = rows.get(r.experiment.Ts_s, 0) + r.rows
    Ts_s = max(rows, key=lambda key: rows[key])
    length = 2 ** round(np.log2(_SEGMENT_S / Ts_s))
    window = np.hanning(length)[:, None]
    freq_hz = np.asarray(np.fft.rfftfreq(length, Ts_s), np.float64)
    use = (freq_hz >= _LOWEST_HZ) & (freq_hz <= _HIGHEST / Ts_s)
    shape = (int(use.sum()), over_sensors.shape[1])
    yu, uu, yy, count = np.zeros(shape, complex), np.zeros(shape), np.zeros(shape), 0
    for r in records:
        if r.experiment.Ts_s != Ts_s:
            continue
        late = r.experiment.delay_cycles
        y, u = r.gap @ over_sensors, np.roll(r.coil @ over_coils, late, axis=0)
        for start in range(late, r.rows - length + 1, length // 2):
            part = slice(start, start + length)
            Y, U = (
                np.fft.rfft(window * (v[part] - v[part].mean(axis=0)), axis=0)[use] for v in (y, u)
            )
            yu += Y * U.conj()
            uu += np.abs(U) ** 2
            yy += np.abs(Y) ** 2
            count += 1
    if not count:
        return []
    each = zip(yu.T / count, uu.T / count, yy.T / count, strict=True)
    return [_Spectra(freq_hz[use], *one, count) for one in each]


def _response(freq_hz: Array, f_hz: float, zeta: float) -> NDArray[np.complex128]:
    ratio = freq_hz / f_hz
    return np.asarray(1.0 / (1.0 - ratio**2 + 2j * zeta * ratio))


def _explained(spectra: _Spectra, f_hz: float, zeta: float) -> tuple[float, float]:
    """Return the power of y that a resonance explains, at any gain and phase, and how surely.

    The second is that power over what noise of y's own power would give on average.
    """
    G = _response(spectra.freq_hz, f_hz, zeta)
    power = np.abs(G) ** 2 * spectra.uu
    whole = float(power.sum())
    if whole <= 0.0:
        return 0.0, 0.0
    explained = float(np.abs(np.sum(G.conj() * spectra.yu)) ** 2 / whole)
    noise = float(power @ spectra.yy) / whole / spectra.count
    return explained, explained / max(noise, 1e-300)


def _fitted(spectra: _Spectra, f_hz: float) -> tuple[float, float]:
    """Return frequency and damping that explain most, from a frequency nearby."""

    def at(p: Array) -> tuple[float, float]:
        low, high = np.log(spectra.freq_hz[[0, -1]])
        return float(np.exp(np.clip(p[0], low, high))), float(np.exp(np.clip(p[1], *_LOG_DAMPING)))

    def unexplained(p: Array) -> float:
        return -_explained(spectra, *at(p))[0]

    start: Array = np.log(np.array([f_hz, _DAMPING]))
    simplex = start + np.array([[0.0, 0.0], [_STEP, 0.0], [0.0, -1.0]])
    found = fmin(unexplained, start, initial_simplex=simplex, xtol=1e-4, ftol=np.inf, disp=False)
    return at(np.asarray(found))
