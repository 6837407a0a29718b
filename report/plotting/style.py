"""Style of all figures: light and dark palette, line styles, sheet sizes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator


@dataclass(frozen=True)
class Colour:
    """A colour by role: as drawn and on light pages, and on dark pages."""

    role: str
    light: str
    dark: str


# The palette of Okabe and Ito is distinguishable with every colour vision; the dark variants have
# the same hue and more lightness. Light values are unique: the page finds the roles by them.
COLOURS: tuple[Colour, ...] = (
    Colour("ink", "#1d2126", "#e8eaed"),
    Colour("muted", "#5b626c", "#a9b1bc"),
    Colour("edge", "#b4bac2", "#4d5663"),
    Colour("grid", "#e3e6ea", "#2b323c"),
    Colour("paper", "#ffffff", "#171b21"),
    Colour("shade", "#f3f4f6", "#20262e"),
    Colour("truth", "#7d848d", "#98a1ac"),
    Colour("blue", "#0072b2", "#4ba8e0"),
    Colour("vermillion", "#d55e00", "#f28a3d"),
    Colour("green", "#009e73", "#38c99c"),
    Colour("purple", "#cc79a7", "#dc9bc0"),
    Colour("orange", "#e69f00", "#f2b632"),
    Colour("sky", "#56b4e9", "#86cbf2"),
)
_LIGHT = {colour.role: colour.light for colour in COLOURS}


def colour(role: str) -> str:
    """Return the colour of a role as drawn."""
    return _LIGHT[role]


@dataclass(frozen=True)
class LineStyle:
    """Line style of a curve; colour and dashes both identify it, also in a grey print."""

    colour: str
    dashes: tuple[float, ...] = ()
    width: float = 1.3
    alpha: float = 1.0
    zorder: float = 3.0

    def keywords(self) -> dict[str, Any]:
        """Return the keywords of Axes.plot."""
        linestyle: object = (0.0, self.dashes) if self.dashes else "solid"
        return {
            "color": self.colour,
            "linestyle": linestyle,
            "linewidth": self.width,
            "alpha": self.alpha,
            "zorder": self.zorder,
        }


_CYCLE: tuple[LineStyle, ...] = (
    LineStyle(_LIGHT["blue"]),
    LineStyle(_LIGHT["vermillion"], (5.0, 1.6)),
    LineStyle(_LIGHT["green"], (5.0, 1.4, 1.2, 1.4)),
    LineStyle(_LIGHT["purple"], (1.6, 1.2)),
    LineStyle(_LIGHT["orange"], (8.0, 1.6)),
    LineStyle(_LIGHT["sky"], (3.0, 1.2)),
)
DOF = {
    "psi": LineStyle(_LIGHT["purple"]),
    "theta": LineStyle(_LIGHT["orange"]),
    "z": LineStyle(_LIGHT["sky"]),
}
"""Lines of the platform's DOFs in a common panel; the colours differ from beam positions'."""
TRUTH = LineStyle(_LIGHT["truth"], width=2.6, alpha=0.55, zorder=2.0)
DOTS = (1.0, 1.5)
"""Dashes of unreliable results, which no other line has."""
BOUND = LineStyle(_LIGHT["ink"], (2.0, 2.0), width=0.8, zorder=2.5)


def doubtful(line: LineStyle) -> LineStyle:
    """Return the dotted line of an unreliable result, in the colour of its position."""
    return replace(line, dashes=DOTS, zorder=2.8)


def line_of(index: int) -> LineStyle:
    """Return the line of the index-th beam position (or axis, or method), from left to right."""
    again, place = divmod(index, len(_CYCLE))
    line = _CYCLE[place]
    if not again:
        return line
    # Colours repeat with thinner lines and one more dot in the dashes each time.
    dots = (1.0, 1.2) * again
    return replace(line, dashes=(*(line.dashes or (12.0, 1.2)), *dots), width=0.8 * line.width)


def position_label(beam_m: float | None, positions_m: Sequence[float | None]) -> str:
    """Return the label of a beam position among a report's, such as 'left (−100 mm)' of three."""
    if beam_m is None:
        return "plant"
    known = sorted(p for p in positions_m if p is not None)
    if len(known) == 1:
        return f"beam at {signed(1e3 * beam_m, 0)} mm"
    names = {2: ("left", "right"), 3: ("left", "middle", "right")}.get(len(known), ())
    value = f"{signed(1e3 * beam_m, 0)} mm"
    return f"{names[known.index(beam_m)]} ({value})" if names and beam_m in known else value


def signed(value: float, digits: int) -> str:
    """Return a number with its sign, a true minus, and no sign at zero."""
    text = f"{value:+.{digits}f}"
    return text[1:] if float(text) == 0 else text.replace("-", "−")


_TAKE_PREFIX = frozenset(
    ("m", "rad", "s", "N", "V", "A", "Hz", "K", "W", "Pa", "J", "g", "F", "H", "T")
)


def engineering(largest: float, unit: str = "m") -> tuple[float, str]:
    """Return factor and SI prefix that scale a value to 1 .. 1000, or 1 and '' for other units.

    A unit that already has a prefix or a power gets no prefix.
    """
    first = unit.replace("/", " ").replace("*", " ").replace("·", " ").split(" ")[0]
    if first not in _TAKE_PREFIX or not np.isfinite(largest) or largest <= 0:
        return 1.0, ""
    power = int(np.clip(np.floor(np.log10(largest) / 3 + 1e-9), -4, 2))
    return 10.0 ** (-3 * power), ("p", "n", "µ", "m", "", "k", "M")[power + 4]


@dataclass(frozen=True)
class Sheet:
    """Format of a figure: width in inches, font size in points, factor on line widths."""

    width_in: float
    font_pt: float
    line: float = 1.0


PAGE = Sheet(width_in=9.6, font_pt=9.5)
PAPER = Sheet(width_in=7.16, font_pt=8.0, line=0.8)  # both columns of a two-column article


@contextmanager
def drawing(sheet: Sheet = PAGE) -> Iterator[None]:
    """Apply this style while the `with` body runs, without pyplot's global state."""
    with mpl.rc_context({**_changed_defaults(), **_rc(sheet)}), warnings.catch_warnings():
        # A name may have letters that DejaVu Sans lacks; in an SVG the reader's fonts show them.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        yield


def _changed_defaults() -> dict[Any, Any]:
    """Return the defaults of what the user's matplotlibrc changed, such as `text.usetex`."""
    now = dict.items(mpl.rcParams)  # without resolving the backend
    default = mpl.rcParamsDefault
    return {
        name: dict.__getitem__(default, name)
        for name, value in now
        if name in default
        and not name.startswith(_NOT_DRAWN)
        and value != dict.__getitem__(default, name)
    }


_NOT_DRAWN = ("backend", "interactive", "toolbar", "webagg", "tk.", "macosx", "figure.raise_window")
"""Settings of windows, which belong to the user's own figures."""


def new_figure(sheet: Sheet, height_in: float) -> Figure:
    """Return an empty figure of the sheet's width."""
    return Figure(figsize=(sheet.width_in, height_in), facecolor="none")


def _rc(sheet: Sheet) -> dict[Any, Any]:
    size = sheet.font_pt
    return {
        "font.family": "DejaVu Sans",  # comes with matplotlib: the same layout everywhere
        "font.size": size,
        "axes.titlesize": size,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.titlepad": 5.0,
        "axes.labelsize": size,
        "axes.labelcolor": _LIGHT["muted"],
        "axes.titlecolor": _LIGHT["ink"],
        "axes.edgecolor": _LIGHT["edge"],
        "axes.facecolor": "none",
        "axes.linewidth": 0.8,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.unicode_minus": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "grid.color": _LIGHT["grid"],
        "grid.linewidth": 0.7,
        "xtick.color": _LIGHT["edge"],
        "ytick.color": _LIGHT["edge"],
        "xtick.labelcolor": _LIGHT["muted"],
        "ytick.labelcolor": _LIGHT["muted"],
        "xtick.labelsize": size - 1.0,
        "ytick.labelsize": size - 1.0,
        "text.color": _LIGHT["ink"],
        "legend.frameon": False,
        "legend.fontsize": size,
        "legend.handlelength": 2.6,
        "legend.columnspacing": 1.8,
        "lines.linewidth": 1.3 * sheet.line,
        "patch.linewidth": 0.6,
        "text.parse_math": False,  # a name from a log is a name, dollar signs and all
        "path.simplify": True,
        "path.simplify_threshold": 0.2,  # of a pixel at 72 dpi: not to be seen, half the bytes
        "svg.fonttype": "none",  # text stays text: small, searchable, in the reader's own font
        "svg.hashsalt": "levid",
    }


_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def power_of_ten(value: float, _position: int | None = None) -> str:
    """Return a tick's label such as 10⁻³ as plain text, which needs no mathematics in the SVG."""
    if value <= 0:
        return ""
    exponent = round(float(np.log10(value)))
    if not np.isclose(value, 10.0**exponent, rtol=1e-6):
        return ""
    return "10" + str(exponent).translate(_SUPERSCRIPT)


def log_ticks(ax: Axes, which: str, limits: tuple[float, float], every: int | None = None) -> None:
    """Make an axis logarithmic with ticks at powers of ten, every second one if too dense."""
    axis = ax.xaxis if which == "x" else ax.yaxis
    (ax.set_xscale if which == "x" else ax.set_yscale)("log")
    (ax.set_xlim if which == "x" else ax.set_ylim)(*limits)
    decades = np.log10(limits[1] / limits[0])
    step = every or max(1, int(np.ceil(decades / 6)))
    axis.set_major_locator(_Decades(step))
    axis.set_major_formatter(FuncFormatter(power_of_ten))
    axis.set_minor_locator(NullLocator() if decades > 2.5 else LogLocator(subs=(2, 5)))
    axis.set_minor_formatter(NullFormatter())


def frequency_axis(ax: Axes, limits: tuple[float, float]) -> None:
    """Make x a logarithmic frequency axis in Hz with plain numbers as tick labels."""
    ax.set_xscale("log")
    ax.set_xlim(*limits)
    ticks = [t for t in _ONE_TWO_FIVE if limits[0] * 0.999 <= t <= limits[1] * 1.001]
    decades = np.log10(limits[1] / limits[0])
    shown = [t for t in ticks if decades < 2.5 or power_of_ten(t)]
    ax.set_xticks(shown, [f"{t:g}" for t in shown])
    ax.xaxis.set_minor_locator(NullLocator())


class _Decades(LogLocator):
    """Ticks at every `step`-th power of ten, counted from 1."""

    def __init__(self, step: int) -> None:
        super().__init__(numticks=100)
        self._step = step

    def tick_values(self, vmin: float, vmax: float) -> list[float]:
        low, high = np.ceil(np.log10(vmin) - 1e-9), np.floor(np.log10(vmax) + 1e-9)
        exponents = np.arange(low, high + 1)
        kept = exponents[exponents % self._step == 0]
        return [float(10.0**e) for e in (kept if kept.size else exponents)]


_ONE_TWO_FIVE = tuple(float(f"{m}e{e}") for e in range(-6, 7) for m in (1, 2, 5))
