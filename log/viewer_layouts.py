"""Write layouts of Foxglove and PlotJuggler for the rows of a rig, live or from a log.

Both show the fields of the topic of the logs, which the live view sends as well. Values are in SI
units, as in the log.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple
from xml.etree import ElementTree as Xml

import numpy as np

from .signals import SIGNALS, cycle_dtype
from .writer import TOPIC

FOXGLOVE, PLOTJUGGLER = "foxglove.json", "plotjuggler.xml"
_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#56b4e9", "#cc79a7", "#7f7f7f", "#b8a600")
"""Colours that readers with any colour vision tell apart (Okabe and Ito, 2008)."""


class Plot(NamedTuple):
    """One plot: its title and its fields, such as `gap_m[0]`."""

    title: str
    fields: tuple[str, ...]


def layouts(coils: int, sensors: int) -> dict[str, str]:
    """Return the layouts of a rig by file name."""
    plots = plots_of(coils, sensors)
    return {FOXGLOVE: _foxglove(plots), PLOTJUGGLER: _plotjuggler(plots)}


def plots_of(coils: int, sensors: int) -> list[Plot]:
    """Return the plots: displacements with their references, gaps, forces and times of a cycle."""
    dtype = cycle_dtype(coils, sensors)
    plots = []
    for unit, title in (("rad", "angles in rad"), ("m", "displacements in m")):
        fields = []
        for signal in SIGNALS:
            stem, _, ending = signal.name.rpartition("_")
            reference = f"{stem}_ref_{unit}"
            if ending == unit and reference in (dtype.names or ()):
                fields += [signal.name, reference]
        plots.append(Plot(title, tuple(fields)))
    for name, title in (
        ("gap_m", "gaps in m"),
        ("coil_n", "coil forces commanded in N"),
        ("coil_readback_n", "coil forces measured in N"),
    ):
        plots.append(Plot(title, _elements(dtype, name)))
    return [*plots, Plot("lateness and execution in s", ("lateness_s", "execution_s"))]


def _elements(dtype: np.dtype[np.void], name: str) -> tuple[str, ...]:
    return tuple(f"{name}[{k}]" for k in range(dtype[name].shape[0]))


def _colour(k: int) -> str:
    return _COLOURS[k % len(_COLOURS)]


def _foxglove(plots: list[Plot]) -> str:
    panels: dict[str, Any] = {
        f"Plot!{k}": {
            "title": plot.title,
            "paths": [
                {
                    "value": f"{TOPIC}.{field}",
                    "label": field,
                    "enabled": True,
                    "timestampMethod": "receiveTime",
                    "color": _colour(n),
                }
                for n, field in enumerate(plot.fields)
            ],
            "showXAxisLabels": True,
            "showYAxisLabels": True,
            "showLegend": True,
            "legendDisplay": "floating",
            "isSynced": True,
            "xAxisVal": "timestamp",
            "followingViewWidth": 20,
        }
        for k, plot in enumerate(plots)
    }
    panels["StateTransitions!0"] = {
        "title": "state and fault",
        "paths": [
            {"value": f"{TOPIC}.{name}", "label": name, "timestampMethod": "receiveTime"}
            for name in ("state", "fault")
        ],
        "isSynced": True,
    }
    panels["Log!0"] = {"title": "events", "topicToRender": "/levid/events"}
    columns = _split("row", *(_split("column", *names) for names in _halves(list(panels))))
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": columns,
    }
    return json.dumps(layout, indent=1) + "\n"


def _halves(names: list[str]) -> tuple[list[str], list[str]]:
    return names[::2], names[1::2]


def _split(direction: str, *parts: Any) -> Any:
    """Return parts of equal size beside each other (row) or above each other (column)."""
    if len(parts) == 1:
        return parts[0]
    return {
        "direction": direction,
        "splitPercentage": round(100 / len(parts), 2),
        "first": parts[0],
        "second": _split(direction, *parts[1:]),
    }


def _plotjuggler(plots: list[Plot]) -> str:
    root = Xml.Element("root")
    widget = Xml.SubElement(root, "tabbed_widget", {"parent": "main_window", "name": "Main Window"})
    tab = Xml.SubElement(widget, "Tab", tab_name="levid", containers="1")
    columns = _splitter(Xml.SubElement(tab, "Container"), "-", 2)
    state = Plot("state and fault", ("state", "fault"))
    for half in ([*plots, state][::2], [*plots, state][1::2]):
        rows = _splitter(columns, "|", len(half))
        for plot in half:
            area = Xml.SubElement(rows, "DockArea", name=plot.title)
            shown = Xml.SubElement(
                area, "plot", mode="TimeSeries", style="Lines", flip_x="false", flip_y="false"
            )
            Xml.SubElement(shown, "range", left="0", right="20", bottom="-1", top="1")
            Xml.SubElement(shown, "limitY")
            for k, field in enumerate(plot.fields):
                Xml.SubElement(shown, "curve", name=f"{TOPIC}/{field}", color=_colour(k))
    Xml.SubElement(widget, "currentTabIndex", index="0")
    Xml.SubElement(root, "use_relative_time_offset", enabled="1")
    Xml.indent(root, " ")
    return Xml.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _splitter(parent: Xml.Element, orientation: str, count: int) -> Xml.Element:
    sizes = ";".join(f"{1 / count:.6f}" for _ in range(count))
    return Xml.SubElement(
        parent, "DockSplitter", orientation=orientation, count=str(count), sizes=sizes
    )
