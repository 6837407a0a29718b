"""Test the report on multisines: distortion is reported if and only if there is any."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from levid.identification.nonparametric.nonlinear_distortion import DetectionLines
from levid.identification.nonparametric.robust_multisine import BestLinearApproximation
from levid.report.identification.identification_page import identification_report
from levid.report.identification.multisine import (
    multisine_numbers,
    multisine_report,
    multisine_words,
)
from levid.report.plotting.labelled_frequency_responses import RIG_SIGNALS

pytestmark = pytest.mark.usefixtures("no_warnings")

FREQ_HZ = np.arange(0.5, 100.0, 0.5)
EXPERIMENTS, PERIODS = 9, 4


def plant(_beam_m, freq_hz):
    """Return the response of three uncoupled, equal oscillators at 5 Hz."""
    s = 2j * np.pi * freq_hz
    return (1.0 / (s**2 + 3.0 * s + 1000.0))[:, None, None] * np.eye(3)


def approximation(beam_m=0.0, distorted=1.0, m=3):
    """Return an exact H with noise of 1e-3; `distorted` scales the scatter power of output 0."""
    rng = np.random.default_rng(round(1e3 * beam_m) + 500)
    H = plant(beam_m, FREQ_HZ)[:, :m, :m]
    F = len(FREQ_HZ)
    variance = 1e-6 * np.abs(np.einsum("fii->f", H) / m) ** 2
    covariance = np.einsum("f,ik,jl->fijkl", variance, np.eye(m), np.eye(m)).astype(complex)
    freedom, noise_freedom = EXPERIMENTS - m, EXPERIMENTS * (PERIODS - 1)

    def level(power, degrees):
        scale = np.ones(m)
        scale[0] = power
        chance = rng.chisquare(2 * degrees, (F, m)) / (2 * degrees)
        return 1e-3 * np.sqrt(scale * chance)

    def lines(power):
        noise = level(1.0, noise_freedom)
        return DetectionLines(FREQ_HZ, level(power, EXPERIMENTS), noise, EXPERIMENTS, noise_freedom)

    return BestLinearApproximation(
        freq_hz=FREQ_HZ,
        H=H.astype(complex),
        covariance=covariance,
        noise_covariance=covariance,
        distortion_variance=np.zeros((F, m, m)),
        freedom=freedom,
        noise_freedom=noise_freedom,
        output_level=np.ones((F, m)),
        total_level=level(distorted, freedom),
        noise_level=level(1.0, noise_freedom),
        even=lines(1.0),
        odd=lines(distorted),
        Ts_s=1e-3,
        input_names=RIG_SIGNALS.input_names[:m],
        input_units=RIG_SIGNALS.input_units[:m],
        output_names=RIG_SIGNALS.output_names[:m],
        output_units=RIG_SIGNALS.output_units[:m],
        beam_m=beam_m,
        records=(f"at {1e3 * beam_m:g} <mm>",),
        remarks=(f"at {1e3 * beam_m:g} <mm>: it <shook>", "one <transient>"),
    )


def text_of(texts):
    return " ".join(t.text for t in texts)


def test_linear_plant_is_reported_as_linear():
    report = multisine_report([approximation(b) for b in (-0.1, 0.0, 0.1)], RIG_SIGNALS)
    assert "No nonlinear distortion" in text_of(multisine_words(report))
    assert report.labels == ("left (−100 mm)", "middle (0 mm)", "right (+100 mm)")
    # Radius at 95 %: sqrt(n (0.05^(-1/n) - 1)) = 1.97 deviations of 1e-3 for n = 6: 0.017 dB.
    assert report.uncertainty_db() == pytest.approx(0.0171, rel=0.01)


def test_distortion_is_reported_with_output_kind_and_position():
    """Four times the noise power at 199 lines is significant."""
    blas = [approximation(-0.1), approximation(0.1, distorted=4.0)]
    report = multisine_report(blas, RIG_SIGNALS)
    text = text_of(multisine_words(report))
    assert "stands above the noise in ψ, most in ψ, beam right (+100 mm)" in text
    assert "an odd nonlinearity" in text
    # Three times the noise, 1e-6 of the output: -55 dB.
    assert "−55 dB" in [n.value for n in multisine_numbers(report)]


def test_order_of_positions_does_not_matter():
    blas = [approximation(b) for b in (0.1, -0.1, 0.0)]
    beams = [bla.beam_m for bla in multisine_report(blas, RIG_SIGNALS).blas]
    assert beams == [-0.1, 0.0, 0.1]


def test_one_realisation_does_not_separate_distortion(tmp_path):
    nothing = np.full((len(FREQ_HZ), 3, 3), np.nan)
    single = replace(approximation(), distortion_variance=nothing)
    report = multisine_report([single], RIG_SIGNALS)
    assert "cannot be told apart" in text_of(multisine_words(report))
    identification_report(None, None, tmp_path, multisine=[single])
    # Detection lines show it if there is distortion.
    distorted = replace(approximation(distorted=4.0), distortion_variance=nothing)
    report = multisine_report([distorted], RIG_SIGNALS)
    assert "is not told by one realisation: lines left out show an odd" in text_of(
        multisine_words(report)
    )
    assert "odd" in [n.value for n in multisine_numbers(report)]


def test_page_of_multisines_alone(tmp_path):
    blas = [approximation(b, distorted=4.0) for b in (-0.1, 0.0, 0.1)]
    page = identification_report(None, None, tmp_path, plant, multisine=blas)
    text = page.read_text(encoding="utf-8").replace("\u00a0", " ")
    for expected in (
        *("Best linear approximation", "Noise and distortion apart", "τψ → ψ"),
        *("truth of the simulator", "it &lt;shook&gt;", "one &lt;transient&gt;", "at half of it"),
    ):
        assert expected in text, expected
    assert "<mm>" not in text
    assert 'class="good"' in text  # H is the truth itself
    assert sorted(f.stem for f in (tmp_path / "figures").iterdir()) == [
        *("distortion-lines", "distortion-response", "multisine-agreement"),
        *("multisine-magnitude", "multisine-phase"),
    ]
    assert max(f.stat().st_size for f in (tmp_path / "figures").iterdir()) < 300_000


def test_names_and_units_are_those_of_the_records(tmp_path):
    named = replace(
        approximation(m=2),
        input_names=("left", "right"),
        input_units=("V", "A"),
        output_names=("tip", "heel"),
        output_units=("m", "rad"),
    )
    page = identification_report(None, None, tmp_path, multisine=[named])
    text = page.read_text(encoding="utf-8").replace("\u00a0", " ")
    assert "left → heel" in text
    assert "rad/V" in text


def test_notes_list_omitted_records(tmp_path):
    page = identification_report(
        None, None, tmp_path, multisine=[approximation()], notes=("x.mcap: kind <land>",)
    )
    assert "kind &lt;land&gt;" in page.read_text(encoding="utf-8")


def test_levels_of_one_position_are_labelled_by_record():
    whole, half = (replace(approximation(0.1), records=(name,)) for name in ("whole", "half"))
    report = multisine_report([whole, approximation(-0.1), half], RIG_SIGNALS)
    assert report.labels == ("left (−100 mm)", "right (+100 mm), whole", "right (+100 mm), half")
    assert "2 beam positions" in str(multisine_words(report)[0])
