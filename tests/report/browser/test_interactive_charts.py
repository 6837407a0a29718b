"""Test report pages in a real browser: zoom, read values, hide curves, print, narrow screens."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from headless_browser import Page, browser

from levid.report.commissioning.platform_drawing import Drawn, platform_drawing
from levid.report.figures.bode import bode_magnitude
from levid.report.plotting.figure_to_svg import Picture, to_svg
from levid.report.plotting.html_page import Section, Steps, Table, Text, write_report
from levid.report.plotting.labelled_frequency_responses import RIG_SIGNALS, Curve, Range
from levid.report.plotting.min_max_envelope import envelope, plot_envelope
from levid.report.plotting.panel_grid import entry, new_grid
from levid.report.plotting.style import PAGE, LineStyle, colour, drawing

RATE_HZ = 1000.0
T_S = 5.0 + np.arange(40_000) / RATE_HZ
UP, DOWN = (np.random.default_rng(k).normal(0, 20.0, len(T_S)) for k in (1, 2))
DOWN[7_777] = 321.0
SHOWN = Range(1.0, 100.0, 64.0, 1.0)
FREQ_HZ = np.geomspace(1.0, 100.0, 200)
BLUE, ORANGE = LineStyle(colour("blue")), LineStyle(colour("vermillion"), (5.0, 1.6))


def time_figure():
    """Two signals of 40 s at 1 kHz in two panels, and one of them again in the second."""
    with drawing():
        grid = new_grid((2, 1), PAGE, 1.6, [entry("up", BLUE), entry("down", ORANGE)])
        for ax, signals in zip(
            grid.axes[:, 0], ([(UP, BLUE)], [(DOWN, ORANGE), (UP, BLUE)]), strict=True
        ):
            for values, line in signals:
                plot_envelope(ax, envelope(T_S, values, 500), line)
            ax.margins(x=0)
            ax.set_title("µm", loc="right")
        grid.axes[-1, 0].set_xlabel("time [s]")
    return grid.figure


def bode_figure():
    response = np.zeros((len(FREQ_HZ), 3, 3), complex)
    for k in range(3):
        response[:, k, k] = 1e-2 / (1 - (FREQ_HZ / 8.0) ** 2 + 0.1j * FREQ_HZ / 8.0)
    deviation = 0.05 * np.abs(response)
    return bode_magnitude(
        [Curve("left", BLUE, FREQ_HZ, response, deviation)], RIG_SIGNALS, shown=SHOWN
    )


def written(folder: Path) -> Path:
    wide = ("a long heading of a column",) * 9
    place = [Drawn(k, 0.1 * k, 0.0, "right") for k in range(3)]
    pictures = (
        Picture("time", to_svg(time_figure()), "two signals", "Two signals."),
        Picture("bode", to_svg(bode_figure()), "a Bode diagram", "A Bode diagram."),
        Picture("platform", to_svg(platform_drawing(place, place)), "platform", "No chart."),
    )
    sections = (
        Section("Summary", (Text("word " * 60, "lead"), Text("x" * 300))),
        Section("Figures", pictures),
        Section("Tables", (Table("Wide", wide, (wide, wide)),)),
        Section("Next", (Steps((("Do it.", "levid identify " + "/very/long" * 30),)),)),
    )
    return write_report(folder, "Title", sections)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def tab(window: Page) -> Page:
    window.medium()
    window.resize()
    return window


@pytest.fixture
def page(tab: Page, report: Path) -> Page:
    tab.open(report.as_uri())
    tab.wait_for("document.querySelectorAll('figure.live').length === 2")
    tab.wait_for("document.querySelectorAll('#figure-time .u-over').length === 2")
    tab.value("document.querySelector('#figure-time').scrollIntoView({block: 'center'})")
    return tab


def plot(page: Page, figure: str, panel: int) -> tuple[float, float, float, float]:
    """Return left, top, width and height of a panel's plot in the window."""
    box = page.value(
        f"(() => {{ const r = document.querySelectorAll('#figure-{figure} .u-over')[{panel}]"
        ".getBoundingClientRect(); return [r.left, r.top, r.width, r.height]; })()"
    )
    left, top, width, height = box
    return left, top, width, height


def drag(page: Page, begin: float, end: float, figure="time", panel=0) -> None:
    """Zoom between two shares of the width, and wait until it is drawn."""
    left, top, width, height = plot(page, figure, panel)
    page.drag(left + begin * width, top + height / 2, left + end * width, top + height / 2)
    settle(page)


def settle(page: Page) -> None:
    page.value("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))")


def point_at(page: Page, share: float, figure="time", panel=0) -> None:
    left, top, width, height = plot(page, figure, panel)
    page.move(left + share * width, top + height / 2)
    settle(page)


def readings(page: Page, figure="time", panel=0) -> tuple[float, list[float]]:
    """Return the abscissa and the values that a panel's readout shows."""
    at, values = page.value(
        f"(() => {{ const box = document.querySelectorAll('#figure-{figure} .readout')[{panel}];"
        "return [box.querySelector('.at').textContent,"
        "[...box.querySelectorAll('.value')].map(v => v.textContent)]; })()"
    )
    return number(at), [number(value) for value in values]


def number(text: str) -> float:
    """Return the first number of a text such as '−1.25·10⁻³ mm'."""
    plain = text.replace("−", "-").translate(str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-"))
    found = re.match(r"(-?[\d.]+)(?:·10(-?\d+))?", plain)
    assert found, text
    return float(found[1]) * 10.0 ** int(found[2] or 0)


def resolution(page: Page) -> str:
    return page.value("document.querySelector('#figure-time .resolution').textContent")


def test_zooming_in_shows_every_sample_and_the_cursor_reads_it(page):
    assert "minimum and maximum of" in resolution(page)
    drag(page, 0.2, 0.4)
    drag(page, 0.25, 0.35)
    assert resolution(page) == "every sample"
    point_at(page, 0.5)
    t_s, (value,) = readings(page)
    row = round((t_s - T_S[0]) * RATE_HZ)
    assert 13.0 < t_s < 21.0
    assert value == pytest.approx(UP[row], abs=6e-3)  # two decimals are shown


def test_panels_have_one_time_axis_and_one_cursor(page):
    drag(page, 0.5, 0.53)
    point_at(page, 0.5)
    first, second = (readings(page, panel=k) for k in (0, 1))
    assert first[0] == pytest.approx(second[0], abs=1.5 / RATE_HZ)
    row = round((second[0] - T_S[0]) * RATE_HZ)
    assert second[1] == pytest.approx([DOWN[row], UP[row]], abs=1e-2)
    assert resolution(page) == "every sample"


def test_whole_record_shows_the_largest_sample(page):
    """A peak of one sample in 40 000 is in the minimum and maximum of its bin."""
    left, top, width, height = plot(page, "time", 1)
    highest = 0.0
    for px in range(-3, 4):  # a bin is 1.4 pixels wide
        page.move(left + 7_777 / len(T_S) * width + px, top + height / 2)
        settle(page)
        texts = page.value(
            "[...document.querySelectorAll('#figure-time .readout')[1].querySelectorAll('.value')]"
            ".map(v => v.textContent)"
        )
        highest = max(highest, *(number(text.split("… ")[1]) for text in texts))
    assert highest == pytest.approx(321.0, abs=1e-2)


@pytest.mark.parametrize("how", ["double click", "Escape", "button"])
def test_zoom_is_reset(page, how):
    drag(page, 0.5, 0.53)
    assert resolution(page) == "every sample"
    left, top, width, height = plot(page, "time", 0)
    if how == "double click":
        page.double_click(left + width / 2, top + height / 2)
    elif how == "Escape":
        page.value("document.querySelector('#figure-time .plot').focus()")
        page.press("Escape")
    else:
        page.value("document.querySelector('#figure-time .reset').click()")
    settle(page)
    assert "minimum and maximum of" in resolution(page)
    assert page.value("document.querySelector('#figure-time .reset').hidden")


def test_wheel_zooms_with_control_only(page):
    left, top, width, height = plot(page, "time", 0)
    where = {"x": left + width / 2, "y": top + height / 2, "deltaX": 0, "deltaY": -100}
    page.command("Input.dispatchMouseEvent", type="mouseWheel", modifiers=2, **where)
    settle(page)
    assert not page.value("document.querySelector('#figure-time .reset').hidden")


def test_keys_zoom_and_read(page):
    page.value("document.querySelector('#figure-time .plot').focus()")
    for key in ("+", "+", "ArrowRight"):
        page.press(key)
    settle(page)
    t_s, _ = readings(page)
    assert T_S[0] < t_s < T_S[-1]
    assert not page.value("document.querySelector('#figure-time .reset').hidden")


def test_legend_entry_hides_its_curve_everywhere(page):
    """No pixel of the curve's colour remains, and its value is not read."""
    vermillion = "[...Array(d.length / 4).keys()].some(i => d[4*i] === 213 && d[4*i+1] === 94)"
    seen = (
        "(() => { const c = document.querySelectorAll('#figure-time canvas')[1];"
        "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        f"return {vermillion}; }})()"
    )
    assert page.value(seen)
    button = "[...document.querySelectorAll('#figure-time button.entry')].find("
    page.value(button + "b => b.textContent === 'down').click()")
    settle(page)
    assert not page.value(seen)
    point_at(page, 0.5)
    assert len(readings(page, panel=1)[1]) == 1
    page.value(button + "b => b.textContent === 'down').click()")
    settle(page)
    assert page.value(seen)


def test_bode_diagram_reads_magnitude_and_band(page):
    page.value("document.querySelector('#figure-bode').scrollIntoView({block: 'center'})")
    point_at(page, 0.25, "bode", 0)
    freq_hz, (value,) = readings(page, "bode", 0)
    row = int(np.argmin(np.abs(np.log(FREQ_HZ / freq_hz))))
    ratio = FREQ_HZ[row] / 8.0
    assert value == pytest.approx(abs(1e-2 / (1 - ratio**2 + 0.1j * ratio)), rel=1e-3)


def test_page_is_readable_without_javascript(tab, report):
    tab.open(report.as_uri(), script=False)
    heights = tab.value(
        "[...document.querySelectorAll('figure .wide > svg')]"
        ".map(s => s.getBoundingClientRect().height)"
    )
    assert len(heights) == 3
    assert min(heights) > 100
    assert tab.value("document.querySelectorAll('.chart').length") == 0


def test_print_shows_the_static_figures(page):
    page.medium("print")
    shown = page.value(
        "['.wide', '.chart'].map(s => getComputedStyle(document.querySelector('#figure-time '"
        " + s)).display)"
    )
    assert shown == ["block", "none"]


@pytest.mark.parametrize("width", [390, 1400])
def test_page_is_as_wide_as_the_window(tab, report, width):
    tab.resize(width)
    tab.open(report.as_uri())
    tab.wait_for("document.querySelectorAll('figure.live').length > 0")
    tab.value("scrollTo(0, document.body.scrollHeight)")
    tab.wait_for("document.querySelectorAll('figure.live').length === 2")
    assert tab.value("document.documentElement.scrollWidth") == width


@pytest.mark.parametrize("width", [390, 1400])
def test_tables_show_every_column_without_scrolling(tab, report, width):
    tab.resize(width)
    tab.open(report.as_uri())
    hidden = (
        "[...document.querySelectorAll('.table .wide')].filter("
        "e => e.scrollWidth > e.clientWidth).length"
    )
    assert tab.value(hidden) == 0
    head = "getComputedStyle(document.querySelectorAll('td')[0], '::before').content"
    assert ("a long heading" in tab.value(head)) == (width == 390)


def box_and_plot(page: Page, figure: str, panel: int) -> tuple[list[float], list[float], int]:
    """Return the place of a panel's visible readout and of its plot, and curve pixels beneath it.

    Curves are saturated; axes, grid and bands are not. No box: an empty list.
    """
    box, over, pixels = page.value(
        f"""(() => {{
        const root = document.querySelectorAll('#figure-{figure} .plot')[{panel}];
        const place = e => {{
          const r = e.getBoundingClientRect(); return [r.left, r.top, r.right, r.bottom]; }};
        const box = root.querySelector('.readout'), over = root.querySelector('.u-over');
        if (box.hidden) return [[], place(over), 0];
        const canvas = root.querySelector('canvas');
        const c = place(canvas), b = place(box), o = place(over);
        const k = canvas.width / (c[2] - c[0]);
        const x0 = Math.max(b[0], o[0]), y0 = Math.max(b[1], o[1]);
        const w = Math.min(b[2], o[2]) - x0, h = Math.min(b[3], o[3]) - y0;
        if (w < 1 || h < 1) return [b, o, 0];
        const part = [(x0 - c[0]) * k, (y0 - c[1]) * k, w * k, h * k];
        const d = canvas.getContext('2d').getImageData(...part).data;
        let found = 0;
        for (let i = 0; i < d.length; i += 4)
          found += Math.max(d[i], d[i + 1], d[i + 2]) - Math.min(d[i], d[i + 1], d[i + 2]) > 90;
        return [b, o, found]; }})()"""
    )  # fmt: skip
    return box, over, int(pixels)


@pytest.mark.parametrize("width", [390, 1400])
@pytest.mark.parametrize(("figure", "panels"), [("bode", 9), ("time", 2)])
def test_values_at_the_cursor_cover_no_curve(tab, report, width, figure, panels):
    tab.resize(width)
    tab.open(report.as_uri())
    tab.value(f"document.querySelector('#figure-{figure}').scrollIntoView()")
    tab.wait_for(f"document.querySelectorAll('#figure-{figure} .u-over').length === {panels}")
    settle(tab)
    for share in (0.05, 0.3, 0.5, 0.62, 0.95):
        point_at(tab, share, figure)
        boxes = [box_and_plot(tab, figure, panel) for panel in range(panels)]
        assert boxes[0][0], "the panel with the cursor shows its values"
        assert [pixels for _, _, pixels in boxes] == [0] * panels


_INK_IN_THE_GAP = """(() => {
  const canvas = document.querySelector('#figure-gap canvas');
  const over = document.querySelector('#figure-gap .u-over').getBoundingClientRect();
  const at = canvas.getBoundingClientRect(), scale = canvas.width / at.width;
  const x = (over.left - at.left + SHARE * over.width) * scale, y = (over.top - at.top) * scale;
  const [width, height] = [0.1 * over.width * scale, over.height * scale];
  const strip = canvas.getContext('2d').getImageData(x, y, width, height);
  let blue = 0;
  for (let i = 0; i < strip.data.length; i += 4)
    if (strip.data[i + 3] > 100 && strip.data[i + 2] > strip.data[i] + 60) blue++;
  return blue;
})()"""


def test_a_gap_in_a_curve_stays_one_beside_curves_with_other_abscissae(tab, tmp_path):
    t = np.arange(101.0)
    with_gap = np.where((t > 30) & (t < 70), np.nan, 1.0)
    with drawing():
        grid = new_grid((1, 1), PAGE, 1.6, [entry("with a gap", BLUE), entry("whole", ORANGE)])
        ax = grid.axes[0, 0]
        ax.plot(t, with_gap, **BLUE.keywords())
        ax.plot(np.arange(0.0, 100.0, 0.3), np.zeros(334), **ORANGE.keywords())
        ax.set_xlabel("time [s]")
    picture = Picture("gap", to_svg(grid.figure), "two curves", "Two curves.")
    tab.open(write_report(tmp_path, "Title", (Section("Figures", (picture,)),)).as_uri())
    tab.wait_for("document.querySelectorAll('#figure-gap .u-over').length === 1")
    assert tab.value(_INK_IN_THE_GAP.replace("SHARE", "0.15")) > 0
    assert tab.value(_INK_IN_THE_GAP.replace("SHARE", "0.45")) == 0


def test_a_band_is_read_with_the_line_that_it_belongs_to(tab, tmp_path):
    """Two models have one legend entry: the pale one has no band of its own."""
    response = 1e-2 / (1 - (FREQ_HZ / 8.0) ** 2 + 0.1j * FREQ_HZ / 8.0)
    whole = response[:, None, None] * np.eye(3)
    pale = LineStyle(BLUE.colour, width=3.0, alpha=0.3)
    figure = bode_magnitude(
        [
            Curve("left", pale, FREQ_HZ, 2.0 * whole),
            Curve("left", BLUE, FREQ_HZ, whole, 0.05 * np.abs(whole)),
        ],
        RIG_SIGNALS,
        shown=SHOWN,
    )
    picture = Picture("bode", to_svg(figure), "a Bode diagram", "A Bode diagram.")
    tab.open(write_report(tmp_path, "Title", (Section("Figures", (picture,)),)).as_uri())
    tab.wait_for("document.querySelectorAll('#figure-bode .u-over').length === 9")
    point_at(tab, 0.2, "bode")
    texts = tab.value(
        "[...document.querySelectorAll('#figure-bode .readout')[0].querySelectorAll('.value')]"
        ".map(v => v.textContent)"
    )
    assert sorted("…" in text for text in texts) == [False, True]
    plain = next(number(text) for text in texts if "…" not in text)
    banded = next(number(text) for text in texts if "…" in text)
    assert plain == pytest.approx(2.0 * banded, rel=1e-2)  # printed digits


def test_dark_pages_have_dark_charts(tab, report):
    tab.medium(dark=True)
    tab.open(report.as_uri())
    tab.wait_for("document.querySelectorAll('#figure-time .u-over').length === 2")
    settle(tab)
    sky = (
        "(() => { const c = document.querySelector('#figure-time canvas');"
        "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        "return [...Array(d.length / 4).keys()].some(i => d[4*i] === 75 && d[4*i+1] === 168); })()"
    )
    assert tab.value(sky)  # blue on dark pages is #4ba8e0
