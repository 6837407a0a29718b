"""A random force is told by its power in a band, alike in still and in excited records."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from levid.identification.trace.residual.random_vibration import ForceSpectrum, shaking

FREQ_HZ = np.arange(501) * 0.25
QUIET = 1e-9 * (1.0 + (FREQ_HZ / 60.0) ** 4)
RMS_N, BAND_HZ = 0.02, (8.0, 25.0)
INSIDE = (BAND_HZ[0] <= FREQ_HZ) & (BAND_HZ[1] > FREQ_HZ)


def spectrum(rng: np.random.Generator, still: bool, shaken: float = 1.0) -> ForceSpectrum:
    """Return averages of ten spectra of noise, z shaken in the band."""
    psd = np.repeat(QUIET[:, None], 3, axis=1)
    psd[INSIDE, 2] += shaken * RMS_N**2 / (BAND_HZ[1] - BAND_HZ[0])
    seen = psd * rng.chisquare(20, psd.shape) / 20
    return ForceSpectrum(FREQ_HZ, seen, np.repeat(QUIET[:, None], 3, axis=1), 10.0, still)


def records(seed: int, excited: float = 1.0, held: float = 1.0, all_: float = 1.0):
    rng = np.random.default_rng(seed)
    fitted = [spectrum(rng, True, all_), *(spectrum(rng, False, all_ * excited) for _ in range(4))]
    return fitted, [spectrum(rng, True, all_ * held), spectrum(rng, False, all_ * held)]


def test_random_force_has_its_band_its_size_and_an_honest_error() -> None:
    errors = []
    for seed in range(40):
        (found,) = shaking(*records(seed))
        assert found.dof == 2
        # A twentieth of the power lies beyond either end of what is told; bins are 0.25 Hz.
        assert found.band_hz == pytest.approx((8.85, 24.15), abs=0.6)
        assert found.statistic > 50
        errors.append((found.rms - RMS_N) / found.se)
    # Bins drawn here are independent and vary by 1 / sqrt(1.5) of those of a window that leaks.
    assert np.abs(np.mean(errors)) < 4 / np.sqrt(40) + 0.3
    assert 0.6 < np.std(errors) < 1.1


def test_error_of_a_force_that_hardly_stands_out_has_the_noise_in_it() -> None:
    """What is left of the power once the noise is taken off is known less well than the whole."""
    errors = []
    for seed in range(200):
        rng = np.random.default_rng(seed)

        def faint(still: bool, rng: np.random.Generator = rng) -> ForceSpectrum:
            flat = np.full((len(FREQ_HZ), 3), 1e-9)
            psd = flat.copy()
            psd[INSIDE, 2] *= 4.0
            seen = psd * rng.chisquare(20, psd.shape) / 20
            return ForceSpectrum(FREQ_HZ, seen, flat, 10.0, still)

        found = shaking([faint(True), *(faint(False) for _ in range(4))], [faint(True)])
        true = np.sqrt(3e-9 * INSIDE.sum() * 0.25)
        errors += [(s.rms - true) / s.se for s in found if s.dof == 2]
    assert len(errors) > 190
    # 0.74 for bins that are independent, and 0.98 of an error without the noise; of 200, 5 % off.
    assert 0.6 < np.std(errors) < 0.86


@pytest.mark.parametrize("seed", range(20))
def test_noise_alone_shakes_nothing(seed: int) -> None:
    assert shaking(*records(seed, all_=0.0)) == ()


@pytest.mark.parametrize(
    "more",
    [{"excited": 10.0}, {"excited": 0.0}, {"held": 0.0}, {"held": 5.0}],
    ids=["grows with the motion", "not in motion", "not held out", "otherwise held out"],
)
def test_what_is_not_always_there_is_something_else(more) -> None:
    assert shaking(*records(1, **more)) == ()


def test_without_still_records_nothing_is_told() -> None:
    fitted, kept = records(1)
    moving = [replace(s, still=False) for s in fitted]
    assert shaking(moving, kept) == ()
    assert shaking(fitted, []) == ()
    assert shaking([], []) == ()


def test_of_several_rates_that_of_the_still_records_is_asked() -> None:
    fitted, kept = records(1)
    # Ten times as fast: as many lines would be another step, and more of them the same.
    fast = np.arange(5001) * 0.25
    faster = ForceSpectrum(fast, np.full((5001, 3), 1e-9), np.full((5001, 3), 1e-9), 10.0, False)
    wider = replace(kept[0], freq_hz=2 * FREQ_HZ)
    assert shaking([*fitted, faster], [*kept, faster, wider]) == shaking(fitted, kept) != ()
