"""Test the detection of spectral lines: close lines, and resonances that are no lines."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from effect_test_helpers import rig_places
from scipy.signal import lfilter

from levid.identification.trace.records.spectral_lines import spectral_lines

TS_S, ROWS = 1e-3, 11_000
NOISE_M = 1e-7


def still(heights_m: np.ndarray, seed: int) -> SimpleNamespace:
    """Return what the detection reads of a still record: a common height, and sensor noise."""
    noise = NOISE_M * np.random.default_rng(seed).standard_normal((ROWS, 9))
    return SimpleNamespace(
        still=True, gap=heights_m[:, None] + noise, places=rig_places(),
        experiment=SimpleNamespace(Ts_s=TS_S),
    )  # fmt: skip


def sines(*parts: tuple[float, float]) -> np.ndarray:
    t = TS_S * np.arange(ROWS)
    return np.sum([size * np.sin(2 * np.pi * f * t + f) for f, size in parts], axis=0)


@pytest.mark.parametrize("apart_hz", [0.2, 0.6, 3.0])
@pytest.mark.parametrize("ratio", [1.0, 0.1])
def test_close_lines_are_both_found(apart_hz: float, ratio: float) -> None:
    # A record of 10 s, one second settled, tells lines from 0.15 Hz on apart.
    record = still(sines((23.0, 1e-5), (23.0 + apart_hz, 1e-5 * ratio)), 1)
    found = sorted(spectral_lines([record]))
    # The bound of the variance of a frequency is far lower; leakage of the other line remains.
    assert found == pytest.approx([23.0, 23.0 + apart_hz], abs=2e-3)


def test_resonance_that_noise_excites_is_no_line() -> None:
    white = np.random.default_rng(2).standard_normal(ROWS)
    w, zeta = 2 * np.pi * 9.0 * TS_S, 0.01
    moved = lfilter([1.0], [1.0, -2 * np.exp(-zeta * w) * np.cos(w), np.exp(-2 * zeta * w)], white)
    assert spectral_lines([still(1e-6 * moved / moved.std(), 3)]) == ()


def test_strong_line_leaves_no_false_ones() -> None:
    # Four decades above the noise of a bin, and slowly growing: no pure sinusoid.
    slow = 1.0 + 1e-3 * np.linspace(-1.0, 1.0, ROWS)
    assert spectral_lines([still(slow * sines((50.0, 1e-4)), 4)]) == pytest.approx(
        (50.0,), abs=1e-3
    )


def test_moving_and_short_records_are_not_used() -> None:
    record = still(sines((30.0, 1e-5)), 5)
    record.still = False
    assert spectral_lines([record]) == ()
    record.still, record.gap = True, record.gap[:1050]
    assert spectral_lines([record]) == ()
