"""Test reproducible figures of the trace report."""

from __future__ import annotations

import re

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from levid.report.plotting.figure_to_svg import to_svg
from levid.report.plotting.style import COLOURS
from levid.report.trace.effect_shapes import Shape, effect_shapes
from levid.report.trace.trace_figures import (
    Bar,
    candidates,
    dependence_map,
    error_spectra,
    errors_by_record,
    sensors_alone,
    squares_over_time,
)


def shape() -> Shape:
    x = np.linspace(-3e-4, 3e-4, 20)
    t = np.linspace(20.0, 24.0, 400)
    wave = np.sin(5 * t)
    return Shape(
        "force on z", "N", "z", "m", x, -(x**3) * 3e8, np.full(20, 1e-4), -(x**3) * 3.01e8,
        "sweep", t, 1e-3 * wave, 1.1e-3 * wave,
    )  # fmt: skip


FREQ = np.linspace(0.0, 500.0, 2001)
FLAT = np.full((2001, 3), 1e-15)
DOF, UNITS = ("psi", "theta", "z"), ("rad", "rad", "m")
BLOCKS = [np.array([2.0, 6.0, 10.0]), np.array([20.0, 24.0])]
ONES = [np.ones(3), np.ones(2)]


@pytest.mark.parametrize(
    "draw",
    [
        lambda: effect_shapes([shape(), shape()]),
        lambda: candidates(
            [
                Bar("Cubic stiffness at z", 99.0, "267 σ", True, True),
                Bar("A", -1.0, "0", False, False),
            ],
            "explained, %",
        ),
        lambda: dependence_map(DOF, ["z", "z'"], None, np.array([[0.0, 0.1]] * 3)),
        lambda: dependence_map(DOF, ["z", "z'"], np.full((3, 2), 0.9), np.zeros((3, 2))),
        lambda: errors_by_record(["a", "b"], DOF, np.full((2, 3), 30.0), np.ones((2, 3))),
        lambda: errors_by_record(["a", "b"], DOF, None, np.ones((2, 3))),
        lambda: errors_by_record(["a", "b"], DOF, None, np.array([[1.0] * 3, [np.inf] * 3])),
        lambda: errors_by_record(["a", "b"], DOF, np.ones((2, 3)), np.full((2, 3), np.nan)),
        lambda: error_spectra(FREQ, (9 * FLAT, np.inf * FLAT, FLAT), DOF, UNITS),
        lambda: error_spectra(FREQ, (9 * FLAT, 2 * FLAT, FLAT), DOF, UNITS),
        lambda: error_spectra(FREQ, (None, 2 * FLAT, FLAT), DOF, UNITS),
        lambda: squares_over_time(BLOCKS, [30 * o for o in ONES], ONES),
        lambda: squares_over_time(BLOCKS, None, ONES),
        lambda: sensors_alone(np.full(9, 40.0), np.ones(9)),
        lambda: sensors_alone(None, np.ones(9)),
    ],
)
def test_figures_are_reproducible_and_use_palette_colours(draw) -> None:
    svg = to_svg(draw())
    assert svg == to_svg(draw())
    # The page replaces colours by value, so a colour outside the palette has no dark variant.
    known = {c.light for c in COLOURS} | {"#000000"}
    assert set(re.findall(r"(?:fill|stroke): (#[0-9a-f]{6})", svg)) <= known


def test_long_names_stay_within_their_figure() -> None:
    name = f"Unbelievably {'long ' * 30}name at coil:0"
    figure = candidates([Bar(name, 1.0, "1", True, True)], "explained, %")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    (label,) = figure.axes[0].get_yticklabels()
    assert label.get_text().startswith("Unbelievably long")
    assert label.get_text().endswith("name at coil:0")
    assert label.get_window_extent().x0 >= 0.0
