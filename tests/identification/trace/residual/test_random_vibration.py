"""Test the detection of random vibration: a force band present in still and excited records."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from levid.identification.trace.residual.random_vibration import ForceSpectrum, shaking

FREQ_HZ = np.arange(501) * 0.25
QUIET = 1e-9 * (1.0 + (FREQ_HZ / 60.0) ** 4)
RMS_N, BAND_HZ = 0.02, (8.0, 25.0)
INSIDE = (BAND_HZ[0] <= FREQ_HZ) & (BAND_HZ[1] > FREQ_HZ)


def spectrum(rng: np.random.Generator, still: bool, vibration: float = 1.0) -> ForceSpectrum:
    """Return averages of ten noise spectra with vibration of z in the band."""
    psd = np.repeat(QUIET[:, None], 3, axis=1)
    psd[INSIDE, 2] += vibration * RMS_N**2 / (BAND_HZ[1] - BAND_HZ[0])
    seen = psd * rng.chisquare(20, psd.shape) / 20
    return ForceSpectrum(FREQ_HZ, seen, np.repeat(QUIET[:, None], 3, axis=1), 10.0, still)


def records(seed: int, excited: float = 1.0, held: float = 1.0, all_: float = 1.0):
    rng = np.random.default_rng(seed)
    fitted = [spectrum(rng, True, all_), *(spectrum(rng, False, all_ * excited) for _ in range(4))]
    return fitted, [spectrum(rng, True, all_ * held), spectrum(rng, False, all_ * held)]


def test_vibration_is_found_with_its_band_rms_and_standard_error() -> None:
    errors = []
    for seed in range(40):
        (found,) = shaking(*records(seed))
        assert found.dof == 2
        # 5 % of the power is outside either end of the reported band; bins are 0.25 Hz.
        assert found.band_hz == pytest.approx((8.85, 24.15), abs=0.6)
        assert found.statistic > 50
        errors.append((found.rms - RMS_N) / found.se)
    # Bins are independent here and scatter by 1 / sqrt(1.5) of those with a window.
    assert np.abs(np.mean(errors)) < 4 / np.sqrt(40) + 0.3
    assert 0.6 < np.std(errors) < 1.1


def test_standard_error_of_a_weak_vibration_includes_the_noise() -> None:
    """After subtraction of the noise power, the relative error is larger."""
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
    # 0.74 is expected for independent bins, and 0.98 if the standard error ignores the noise; 200
    # values determine this to 5 %.
    assert 0.6 < np.std(errors) < 0.86


@pytest.mark.parametrize("seed", range(20))
def test_noise_alone_gives_no_vibration(seed: int) -> None:
    assert shaking(*records(seed, all_=0.0)) == ()


@pytest.mark.parametrize(
    "more",
    [{"excited": 10.0}, {"excited": 0.0}, {"held": 0.0}, {"held": 5.0}],
    ids=["larger in motion", "absent in motion", "absent in held-out", "larger in held-out"],
)
def test_force_that_differs_between_records_is_not_vibration(more) -> None:
    assert shaking(*records(1, **more)) == ()


def test_vibration_needs_a_still_record_and_held_out_records() -> None:
    fitted, kept = records(1)
    moving = [replace(s, still=False) for s in fitted]
    assert shaking(moving, kept) == ()
    assert shaking(fitted, []) == ()
    assert shaking([], []) == ()


def test_records_with_other_frequency_grids_than_the_still_record_are_ignored() -> None:
    fitted, kept = records(1)
    # Ten times the rate: ten times as many lines of the same spacing.
    fast = np.arange(5001) * 0.25
    faster = ForceSpectrum(fast, np.full((5001, 3), 1e-9), np.full((5001, 3), 1e-9), 10.0, False)
    wider = replace(kept[0], freq_hz=2 * FREQ_HZ)
    assert shaking([*fitted, faster], [*kept, faster, wider]) == shaking(fitted, kept) != ()
