"""Estimate frequency and damping of the platform's flexible modes from cross spectra.

For each bending pattern, the cross spectra of the sensors' non-rigid part and the command force in
this pattern are averaged over all records; the resonance that explains most is the initial guess
of the fit. A grid search would miss resonances narrower than its steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import fmin

from ....model.effects.flexible import LOWEST_HZ, PATTERNS, patterns
from ...rounding import DIFFERENCE, TINY
from ..search_options import SearchOptions
from .record_from_log import TraceRecord

Array = NDArray[np.float64]

HIGHEST = 0.5
"""Highest frequency over the sampling rate."""
_LOG_DAMPING = np.log([SearchOptions().negligible, 0.5**0.5])
"""From what is no broader than a line to what has no peak any more."""
_DAMPING = float(np.exp(_LOG_DAMPING.mean()))
_STEP = 0.5 * _DAMPING
"""Relative step of the frequency grid: resonances of the damping above overlap then."""
_SURE = SearchOptions().least_squares
"""Least explained power over that of noise. The largest of some thousand trials was 18 in records
without a resonance."""
_MOST = 2
"""Largest number of resonances of a pattern."""
_BROAD = 0.5
"""Largest damping of a resonance; the grid of the candidates covers larger ones."""


class Resonance(NamedTuple):
    """A bending pattern's name, its frequency in Hz and its damping ratio."""

    pattern: str
    frequency_hz: float
    damping: float


def resonances(records: Sequence[TraceRecord]) -> tuple[Resonance, ...]:
    """Return the resonances of the non-rigid patterns, rounded to three digits.

    Within a pattern, the one that explains most comes first. The result is empty if the positions
    of sensors and coils are unknown. Only records of the most frequent sampling rate are used.
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
class Spectra:
    """Cross and auto spectra (F,) of force u and reading y in a pattern, means of `count`."""

    freq_hz: Array
    yu: NDArray[np.complex128]
    uu: Array
    yy: Array
    count: int

    def without(self, response: NDArray[np.complex128]) -> Spectra:
        """Subtract from y its best fit by a response (F,) to u."""
        gain = np.sum(response.conj() * self.yu) / np.sum(np.abs(response) ** 2 * self.uu)
        made = gain * response
        left = self.yy - 2 * (made.conj() * self.yu).real + np.abs(made) ** 2 * self.uu
        return replace(self, yu=self.yu - made * self.uu, yy=np.maximum(left, 0.0))


def _strongest(spectra: Spectra) -> list[tuple[float, float]]:
    """Return frequencies and dampings of the significant resonances, found one after another."""
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


def clearest(spectra: Spectra) -> tuple[float, float] | None:
    """Return frequency and damping of the resonance that noise is least likely to imitate."""
    if not spectra.uu.any():
        return None
    first, last = spectra.freq_hz[[0, -1]]
    tried = np.exp(np.arange(np.log(first), np.log(last), _STEP))
    sure = [_explained(spectra, f_hz, _DAMPING)[1] for f_hz in tried]
    f_hz, zeta = _fitted(spectra, float(tried[np.argmax(sure)]))
    resolved = zeta > (1.0 + SearchOptions.least_gain) * float(np.exp(_LOG_DAMPING[0]))
    narrow = resolved and zeta <= _BROAD and _explained(spectra, f_hz, zeta)[1] >= _SURE
    return (f_hz, zeta) if narrow else None


def _spectra(
    records: Sequence[TraceRecord], over_sensors: Array, over_coils: Array
) -> list[Spectra]:
    """Return the spectra of each pattern, for over_sensors (S, P) and over_coils (C, P)."""
    rows: dict[float, int] = {}
    for r in records:
        rows[r.experiment.Ts_s] = rows.get(r.experiment.Ts_s, 0) + r.rows
    Ts_s = max(rows, key=lambda key: rows[key])
    length = 2 ** round(np.log2(SearchOptions.block_s / Ts_s))
    window = np.hanning(length)[:, None]
    freq_hz = np.asarray(np.fft.rfftfreq(length, Ts_s), np.float64)
    use = (freq_hz >= LOWEST_HZ) & (freq_hz <= HIGHEST / Ts_s)
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
    return [Spectra(freq_hz[use], *one, count) for one in each]


def _response(freq_hz: Array, f_hz: float, zeta: float) -> NDArray[np.complex128]:
    ratio = freq_hz / f_hz
    return np.asarray(1.0 / (1.0 - ratio**2 + 2j * zeta * ratio))


def _explained(spectra: Spectra, f_hz: float, zeta: float) -> tuple[float, float]:
    """Return the power of y that a resonance explains (any gain and phase), and its significance.

    The significance is this power over the mean that noise of the power of y would give.
    """
    G = _response(spectra.freq_hz, f_hz, zeta)
    power = np.abs(G) ** 2 * spectra.uu
    whole = float(power.sum())
    if whole <= 0.0:
        return 0.0, 0.0
    explained = float(np.abs(np.sum(G.conj() * spectra.yu)) ** 2 / whole)
    noise = float(power @ spectra.yy) / whole / spectra.count
    return explained, explained / max(noise, TINY)


def _fitted(spectra: Spectra, f_hz: float) -> tuple[float, float]:
    """Return the frequency and damping that explain most, starting near `f_hz`."""

    def at(p: Array) -> tuple[float, float]:
        low, high = np.log(spectra.freq_hz[[0, -1]])
        return float(np.exp(np.clip(p[0], low, high))), float(np.exp(np.clip(p[1], *_LOG_DAMPING)))

    def unexplained(p: Array) -> float:
        return -_explained(spectra, *at(p))[0]

    start: Array = np.log(np.array([f_hz, _DAMPING]))
    simplex = start + np.array([[0.0, 0.0], [_STEP, 0.0], [0.0, -1.0]])
    found = fmin(
        unexplained, start, initial_simplex=simplex, xtol=DIFFERENCE, ftol=np.inf, disp=False
    )
    return at(np.asarray(found))
