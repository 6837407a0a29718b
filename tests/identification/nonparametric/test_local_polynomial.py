"""Test the local polynomial method: no leakage, correct intervals, smaller errors than Welch's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from levid.identification.nonparametric import frequency_response
from levid.identification.nonparametric.local_polynomial import (
    local_polynomial,
    plant_by_local_polynomial,
)
from levid.identification.records.record import IdentificationError, Record

TS = 0.01
POLE = 0.99 * np.exp(2j * np.pi * 5.0 * TS)  # 5 Hz, damping 0.03: decays by 1 / e in 1 s
A = np.poly([POLE, POLE.conj()]).real
FREQ = np.geomspace(1.0, 40.0, 60)


def plant(freq_hz: np.ndarray) -> np.ndarray:
    """Return a 2 x 2 response: a resonance in each entry, and direct feedthrough."""
    z = np.exp(2j * np.pi * freq_hz * TS)
    resonance = 0.01 / np.polyval(A, z) * z**2
    return resonance[:, None, None] * np.array([[1.0, 0.4], [-0.3, 0.7]]) + 0.1 * np.eye(2)


def records(
    seed: int, *, rows: int = 6000, at_once: bool = False, noise: float = 0.0
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return two records from the middle of an experiment, which start with a transient."""
    rng = np.random.default_rng(seed)
    inputs, outputs = [], []
    for j in range(2):
        v = rng.normal(size=(rows + 1000, 2))
        before = rng.normal(size=(1000, 2))
        if not at_once:
            v[:, 1 - j] = 0.0
        v[:1000] = before
        through = signal.lfilter([0.01], A, v, axis=0)
        y = through @ np.array([[1.0, 0.4], [-0.3, 0.7]]).T + 0.1 * v
        inputs.append(v[1000:])
        outputs.append(y[1000:] + noise * rng.normal(size=(rows, 2)))
    return inputs, outputs


@pytest.mark.parametrize("at_once", [True, False])
def test_response_at_a_resonance_has_no_leakage(at_once: bool) -> None:
    inputs, outputs = records(1, at_once=at_once)
    found = local_polynomial(inputs, outputs, TS, FREQ)
    welch = frequency_response.frequency_response(inputs, outputs, TS, FREQ, 5.0)
    np.testing.assert_array_equal(found.freq_hz, FREQ)
    ours = np.abs(found.H - plant(FREQ)).max()
    theirs = np.abs(welch.H - plant(welch.freq_hz)).max()
    # The band, 19 bins of 1 / 60 Hz, is as wide as the half-power width of the resonance. A
    # polynomial of order 2 fits 1 / (1 + i x), |x| < 1, to about 5 % of the peak.
    peak = np.abs(plant(FREQ)).max()
    assert ours < 0.06 * peak
    assert theirs > 3 * ours
    assert found.coherence.min() > 0.99


def test_bias_falls_with_the_length_of_the_record() -> None:
    """Twice the length gives half the bandwidth: the bias falls with the polynomial's order."""
    errors = []
    for rows in (6000, 12_000, 24_000):
        found = local_polynomial(*records(1, rows=rows), TS, FREQ)
        errors.append(np.sqrt(np.mean(np.abs(found.H - plant(FREQ)) ** 2)))
    # The third order of H is the first that is left out: a factor of 2^3 at each doubling.
    assert errors[0] / errors[1] > 5
    assert errors[1] / errors[2] > 5


@pytest.mark.parametrize("at_once", [True, False])
@pytest.mark.parametrize("freedom", [12, 24])
def test_confidence_intervals_have_the_stated_coverage(at_once: bool, freedom: int) -> None:
    inside = []
    for seed in range(20):
        inputs, outputs = records(seed, at_once=at_once, noise=0.3)
        found = local_polynomial(inputs, outputs, TS, FREQ, freedom)
        error = np.abs(found.H - plant(FREQ))
        inside.append(error < np.sqrt(-np.log(0.05)) * found.standard_deviation)
    # 95 % for a known variance; with 12 degrees of freedom (1 + 3 / 12)^-12 = 6.9 % are outside,
    # with 24 it is 5.9 %. 20 x 60 frequencies, half of them independent: known to 1 %.
    expected = 1.0 - (1.0 - np.log(0.05) / freedom) ** -freedom
    assert np.mean(inside) == pytest.approx(expected, abs=0.02)


def test_records_of_different_lengths_share_one_response() -> None:
    (v1, v2), (y1, y2) = records(3, noise=0.01)
    found = local_polynomial([v1, v2[:4111]], [y1, y2[:4111]], TS, FREQ)
    error = np.abs(found.H - plant(FREQ))
    assert np.mean(error < 1.73 * found.standard_deviation) > 0.85  # the error includes bias
    assert error.max() < 0.1


def test_coherence_falls_with_noise() -> None:
    for noise, low, high in ((0.0, 0.99, 1.0), (0.1, 0.3, 0.99), (30.0, 0.0, 0.5)):
        found = local_polynomial(*records(2, noise=noise), TS, FREQ)
        assert low <= np.median(found.coherence) <= high
        assert found.coherence.min() >= 0.0
        assert found.coherence.max() <= 1.0


@pytest.mark.parametrize("x_b_m", [-0.1, 0.0, 0.1])
def test_errors_on_records_of_the_rig_are_smaller_than_those_of_welch(rig, x_b_m: float) -> None:
    # The first 4 s are cut off, so that the records start with a transient.
    flown = [r.rows(4000, 64_000) for r in rig.records([x_b_m], 1000.0, 64.0)]
    grid = np.geomspace(1.0, 64.0, 120)
    ours = plant_by_local_polynomial(flown, grid)
    welch = frequency_response.plant_from_joint(flown, grid, 10.0)
    errors, near = {}, (grid[:, None] > 2.5) & (grid[:, None] < 10.0)
    for name, found in (("ours", ours), ("welch", welch)):
        true = rig.sampled_plant(x_b_m, 1e-3).frequency_response(found.freq_hz)
        ratio = np.einsum("fii->fi", found.H / true)
        errors[name] = {
            "dB": np.abs(20 * np.log10(np.abs(ratio))).max(),
            "degrees": np.abs(np.angle(ratio, deg=True)).max(),
            "resonances": np.sqrt(np.mean(np.abs(ratio - 1)[near[: len(ratio), 0]] ** 2)),
            "inside": np.mean(np.abs(found.H - true) < 1.73 * found.standard_deviation),
        }
    # Measured: 0.1 to 0.25 dB, 0.5 to 2 degrees. Welch, 10 s segments: 0.3 to 1.1 dB, 2 to 5.
    assert errors["ours"]["dB"] < 0.5
    assert errors["ours"]["degrees"] < 3.0
    assert errors["ours"]["resonances"] < errors["welch"]["resonances"] / 2
    # Three rows of 120 frequencies have a standard error of 1.2 %; 0.9 % come from the finite
    # degrees of freedom.
    assert errors["ours"]["inside"] == pytest.approx(0.941, abs=0.04)


def test_response_without_feedback_is_that_from_v_to_y() -> None:
    inputs, outputs = records(4)
    names = ("a", "b")
    flown = [
        Record(str(k), TS, v, y, names, names, names, names)
        for k, (v, y) in enumerate(zip(inputs, outputs, strict=True))
    ]
    np.testing.assert_array_equal(
        plant_by_local_polynomial(flown, FREQ).H, local_polynomial(inputs, outputs, TS, FREQ).H
    )


def test_records_that_do_not_determine_the_response_are_rejected() -> None:
    inputs, outputs = records(5)
    with pytest.raises(IdentificationError, match=r"at least \d+ samples, found a record of 25"):
        local_polynomial([v[:25] for v in inputs], [y[:25] for y in outputs], TS, FREQ)
    with pytest.raises(IdentificationError, match=r"from 0\.01667 to 49\.98 Hz"):
        local_polynomial(inputs, outputs, TS, np.array([1.0, 60.0]))
    with pytest.raises(IdentificationError, match="every input to be excited"):
        local_polynomial([inputs[0]], [outputs[0]], TS, FREQ)
    alike = [v[:, [j, j]] for j, v in enumerate(inputs)]
    with pytest.raises(IdentificationError, match="independent inputs around"):
        local_polynomial(alike, outputs, TS, FREQ)
