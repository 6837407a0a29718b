"""Test figures of noise and distortion: unusual data, file size."""

from __future__ import annotations

from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest

from levid.report.figures.nonlinear_distortion import (
    Levels,
    OutputLevels,
    Response,
    detection_levels,
    response_with_distortion,
)
from levid.report.plotting.figure_to_svg import to_svg
from levid.report.plotting.labelled_frequency_responses import Range, SignalLabels
from levid.report.plotting.style import PAPER, colour

pytestmark = pytest.mark.usefixtures("no_warnings")

SHOWN = Range(1.0, 100.0, 64.0, 1.0)
AXES = SignalLabels(
    ("tau_psi", "tau_theta", "tau_z"),
    ("N m", "N m", "N"),
    ("psi", "theta", "z"),
    ("rad", "rad", "m"),
)
FREQ_HZ = np.arange(1.0, 100.0, 0.25)


def response(m=3, p=3, freq_hz=FREQ_HZ):
    size = 1.0 / (1.0 + freq_hz[:, None, None] ** 2) * np.ones((m, p))
    return Response(freq_hz, size, 1e-4 * size, 2e-4 * size)


def levels(m=3, freq_hz=FREQ_HZ):
    size = np.ones((len(freq_hz), m)) / freq_hz[:, None]
    part = Levels(freq_hz[1::2], 1e-3 * size[1::2])
    return OutputLevels(Levels(freq_hz, size), part, part, Levels(freq_hz, 1e-4 * size))


def drawn(figure):
    """Return the figure as SVG, which must be valid XML and below 300 KB."""
    svg = to_svg(figure)
    ElementTree.fromstring(svg)
    assert len(svg) < 300_000
    return svg


def test_both_figures_have_labels():
    svg = drawn(response_with_distortion(response(), AXES, shown=SHOWN))
    for text in ("best linear approximation", "noise and distortion", "noise alone", "rad/(N m)"):
        assert text in svg
    svg = drawn(detection_levels(levels(), AXES, shown=SHOWN))
    for text in ("excited lines", "odd lines left out", "even lines left out", "rad rms", "m rms"):
        assert text in svg


def test_figure_uses_palette_colours_only():
    """The page replaces each palette colour by its dark variant."""
    svg = drawn(detection_levels(levels(), AXES, shown=SHOWN))
    for role in ("blue", "vermillion", "green", "muted"):
        assert colour(role) in svg


@pytest.mark.parametrize(("m", "p"), [(1, 1), (2, 3)])
def test_figures_of_systems_of_other_sizes(m, p):
    signals = SignalLabels(("a", "b", "c")[:p], ("",) * p, ("d", "e")[:m], ("1",) * m)
    shown = Range(1.0, 50.0)
    drawn(response_with_distortion(response(m, p), signals, shown=shown))
    svg = to_svg(detection_levels(levels(m), signals, shown=shown, sheet=PAPER), PAPER)
    assert f'width="{72 * PAPER.width_in:g}pt"' in svg


@pytest.mark.parametrize("broken", [np.nan, 0.0, np.inf])
def test_nan_is_omitted(broken):
    r = response()
    nothing = np.full_like(r.magnitude, broken)
    drawn(
        response_with_distortion(
            Response(r.freq_hz, r.magnitude, nothing, nothing), AXES, shown=SHOWN
        )
    )
    drawn(
        response_with_distortion(Response(r.freq_hz, nothing, nothing, nothing), AXES, shown=SHOWN)
    )


def test_figures_without_detection_lines_or_without_lines_in_range():
    none = Levels(np.zeros(0), np.zeros((0, 3)))
    everything = levels()
    drawn(detection_levels(OutputLevels(everything.excited, none, none, none), AXES, shown=SHOWN))
    drawn(detection_levels(OutputLevels(none, none, none, none), AXES, shown=SHOWN))
    drawn(detection_levels(everything, AXES, shown=Range(200.0, 300.0)))


def test_many_lines_are_pooled():
    """A period of 100 s has 10,000 lines up to 100 Hz; the figure has 60 per decade."""
    f = np.arange(1.0, 100.0, 0.01)
    drawn(detection_levels(levels(freq_hz=f), AXES, shown=SHOWN))
    drawn(response_with_distortion(response(freq_hz=f), AXES, shown=SHOWN))


def test_levels_of_an_approximation_keep_every_line_of_noise():
    """The noise is known at excited lines and at detection lines, drawn as one curve."""
    lines = {"freq_hz": np.array([1.0, 3.0]), "output_level": np.ones((2, 3))}
    left_out = [
        SimpleNamespace(freq_hz=np.array([f]), level=np.ones((1, 3)), noise=np.full((1, 3), f))
        for f in (2.0, 5.0)
    ]
    bla = SimpleNamespace(**lines, noise_level=np.ones((2, 3)), even=left_out[0], odd=left_out[1])
    found = OutputLevels.of(bla)
    np.testing.assert_array_equal(np.sort(found.noise.freq_hz), [1.0, 2.0, 3.0, 5.0])
    assert found.noise.level.shape == (4, 3)
