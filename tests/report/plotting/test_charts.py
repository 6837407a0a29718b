"""Test charts derived from figures: their content, their encoding, their size."""

from __future__ import annotations

import base64
import json
import re
import zlib

import numpy as np
import pytest

from levid.report.plotting.chart_encoding import encode, encode_charts
from levid.report.plotting.chart_from_figure import chart_of
from levid.report.plotting.figure_to_svg import Picture, to_svg
from levid.report.plotting.html_page import MOST_BYTES, Section, render
from levid.report.plotting.min_max_bins import all_samples, min_max_bins
from levid.report.plotting.min_max_envelope import envelope, plot_envelope
from levid.report.plotting.panel_grid import entry, new_grid
from levid.report.plotting.style import PAGE, LineStyle, colour, drawing, frequency_axis, log_ticks
from levid.report.plotting.svg_paths import shorter_path

BLUE, DASHED = LineStyle(colour("blue")), LineStyle(colour("green"), (5.0, 1.6))


def drawn(draw, rows=1, legend=()):
    """Return a figure of panels that `draw(axes)` fills."""
    with drawing():
        grid = new_grid((rows, 1), PAGE, 1.5, legend)
        draw(grid.axes[:, 0])
    return grid.figure


def chart(draw, rows=1, legend=()):
    return to_svg(drawn(draw, rows, legend)).chart


def decoded(text):
    """Return the described chart, and each run's abscissae, lower and upper values."""
    raw = zlib.decompress(base64.b64decode(text))
    length = int.from_bytes(raw[:4], "little")
    described, at, arrays, curves = json.loads(raw[4 : 4 + length]), 4 + length, [], []
    for panel in described["panels"]:
        for series in panel["series"]:
            for run in series["runs"]:
                n = run["n"]
                if isinstance(run["x"], list):
                    x = run["x"][0] + run["x"][1] * np.arange(n)
                else:
                    if run["x"] == len(arrays):
                        arrays.append(np.frombuffer(raw, "<f8", n, at))
                        at += 8 * n
                    x = arrays[run["x"]]
                edges = []
                for _ in range(1 + run["two"]):
                    high, low = (np.frombuffer(raw, "u1", n, at + k * n) for k in (0, 1))
                    q = np.cumsum(256 * high.astype(int) + low) % 65_536
                    y = np.where(q == 65_535, np.nan, run["low"] + q * run["step"])
                    edges.append(10**y if panel["y"]["log"] else y)
                    at += 2 * n
                curves.append((x, edges[0], edges[-1]))
    assert at == len(raw)
    return described, curves


def test_curve_is_decoded_within_its_step():
    x = np.geomspace(1.0, 100.0, 77)
    y = 1e-4 * (2.0 + np.sin(x))
    y[5] = np.nan

    def draw(axes):
        axes[0].plot(x, y, **BLUE.keywords())
        frequency_axis(axes[0], (1.0, 100.0))
        log_ticks(axes[0], "y", (1e-5, 1e-2))
        axes[0].set_xlabel("frequency [Hz]")

    described, [(f, low, high)] = decoded(encode(chart(draw)))
    panel = described["panels"][0]
    assert (panel["x"]["label"], panel["x"]["unit"], panel["x"]["log"]) == ("frequency", "Hz", True)
    np.testing.assert_array_equal(f, x)
    np.testing.assert_allclose(low, y, rtol=2e-5)
    np.testing.assert_array_equal(low, high)


def test_legend_entries_are_those_of_their_curves():
    """Curves have no label of their own: colour, dashes and marker identify the entry."""

    def draw(axes):
        axes[0].plot([0, 1], [0, 1], **DASHED.keywords())
        axes[0].plot([0, 1], [1, 0], **BLUE.keywords())
        axes[0].fill_between([0, 1], [0, 0], [1, 1], color=BLUE.colour, alpha=0.2)
        axes[0].axhline(0.5, color=colour("edge"))

    found = chart(draw, legend=[entry("solid", BLUE), entry("dashed", DASHED)])
    assert [found.entries[k].label for k in found.legend] == ["solid", "dashed"]
    panel = found.panels[0]
    assert {(s.kind, s.label) for s in panel.series} == {
        ("line", "solid"),
        ("line", "dashed"),
        ("band", "solid"),
    }
    assert len(panel.marks) == 1


@pytest.mark.parametrize("kind", ["bars", "scatter", "image", "descending", "one point"])
def test_figures_that_are_no_curves_over_x_stay_static(kind):
    def draw(axes):
        ax = axes[0]
        if kind == "bars":
            ax.barh([0, 1], [1, 2])
        elif kind == "scatter":
            ax.scatter([0, 1], [1, 2])
        elif kind == "image":
            ax.imshow(np.eye(3))
        else:
            ax.plot([1, 0], [0, 1]) if kind == "descending" else ax.plot([1], [1], marker="o")

    figure = drawn(draw)
    to_svg(figure)
    assert chart_of(figure) is None


def test_chart_has_every_sample_of_an_envelope():
    t = np.arange(5_000) / 1000.0
    x = np.random.default_rng(1).normal(size=len(t))

    def draw(axes):
        plot_envelope(axes[0], envelope(t, x, 100), BLUE, 1e3)

    _, [(time_s, low, high)] = decoded(encode(chart(draw)))
    np.testing.assert_allclose(time_s, t, atol=1e-9)
    np.testing.assert_allclose(low, 1e3 * x, atol=0.1)
    np.testing.assert_array_equal(low, high)


def test_bins_hold_every_peak_and_kept_rows_stay_samples():
    t = np.arange(100_000) / 1000.0
    x = np.zeros(len(t))
    x[31_415], x[27_182] = 9.0, -7.0
    runs = min_max_bins(t, x, x, most=1000, keep=[(500, 600)])
    assert [run.kept for run in runs] == [False, True, False]
    assert [len(run.t) for run in runs] == [4, 100, 777]
    assert max(run.high.max() for run in runs) == 9.0
    assert min(run.low.min() for run in runs) == -7.0
    assert all(run.count == (1 if run.kept else 128) for run in runs)


def test_missing_time_separates_runs():
    t = np.concatenate([np.arange(100), 200.0 + np.arange(50)]) / 1000.0
    runs = min_max_bins(t, t, t)
    assert [len(run.t) for run in runs] == [100, 50]


def half_an_hour(keep=()):
    """A figure of ten noisy signals over half an hour at 1 kHz."""
    t = np.arange(1_800_000) / 1000.0
    rng = np.random.default_rng(2)

    def draw(axes):
        for ax in axes:
            x = rng.normal(size=len(t)).astype(np.float32)
            plot_envelope(ax, envelope(t, x, 700, keep=keep), BLUE)

    return Section("Time", (Picture("time", to_svg(drawn(draw, 10)), "alt", "caption"),))


def test_half_an_hour_at_1_khz_is_one_page_of_1_5_mb():
    section = half_an_hour(keep=[(900_000, 900_250)])
    page = render("Title", [section])
    assert 0.5 * MOST_BYTES < len(page.encode()) <= MOST_BYTES
    [picture] = section.parts
    [text] = encode_charts([picture.chart], 1_000_000)
    described, _ = decoded(text)
    counts = [run["count"] for run in described["panels"][0]["series"][0]["runs"]]
    assert counts[1] == 1  # rows around an event remain samples
    assert counts[0] == counts[2] > 1
    assert page == render("Title", [section])


def test_full_pages_have_all_samples():
    t = np.arange(200_000) / 1000.0
    x = np.random.default_rng(3).normal(size=len(t))

    def draw(axes):
        plot_envelope(axes[0], envelope(t, x, 700), BLUE)

    for full in (False, True):
        with all_samples(full):
            assert sum(len(run.t) for run in envelope(t, x, 700).samples) == (
                200_000 if full else 100_000
            )
            figure = to_svg(drawn(draw))
            page = render("Title", [Section("A", (Picture("a", figure, "alt", "caption"),))])
        assert "chart-data" in page


def test_shorter_paths_miss_no_vertex_by_more_than_a_quarter_of_a_point():
    rng = np.random.default_rng(4)
    points = np.column_stack([np.linspace(0, 900, 400), 100 + np.cumsum(rng.normal(0, 0.3, 400))])
    text = shorter_path("M " + " L ".join(f"{x:.6f} {y:.6f}" for x, y in points))
    numbers = np.array([float(n) for n in re.findall(r"-?(?:\d+(?:\.\d+)?|\.\d+)", text)])
    kept = np.cumsum(numbers.reshape(-1, 2), axis=0)
    assert len(kept) < 0.8 * len(points)
    y = np.interp(points[:, 0], kept[:, 0], kept[:, 1])
    assert np.max(np.abs(y - points[:, 1])) < 0.3
