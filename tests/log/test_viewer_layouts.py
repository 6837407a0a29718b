"""Test that layouts name fields of the logs, each panel once, and that the shipped ones are new."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import pytest

from levid.config.shipped import shipped
from levid.log.signals import cycle_dtype
from levid.log.viewer_layouts import FOXGLOVE, PLOTJUGGLER, layouts
from levid.log.writer import TOPIC


def is_field(path: str, coils: int, sensors: int) -> bool:
    """Return whether `name` or `name[k]` is a value of a row."""
    name, index = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", path).groups()
    shape = cycle_dtype(coils, sensors)[name].shape
    return (index is None and shape == ()) or (index is not None and int(index) < shape[0])


def panels_of(layout: Any) -> Iterator[str]:
    if isinstance(layout, str):
        yield layout
    else:
        yield from panels_of(layout["first"])
        yield from panels_of(layout["second"])


@pytest.mark.parametrize(("coils", "sensors"), [(9, 9), (4, 6), (1, 1)])
def test_foxglove_layout_shows_each_panel_with_fields_of_the_log(coils: int, sensors: int) -> None:
    layout = json.loads(layouts(coils, sensors)[FOXGLOVE])
    panels = layout["configById"]
    assert sorted(panels_of(layout["layout"])) == sorted(panels)
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", [])]
    assert len(paths) == len(set(paths))
    for path in paths:
        assert path.startswith(f"{TOPIC}.")
        assert is_field(path.removeprefix(f"{TOPIC}."), coils, sensors)
    assert f"{TOPIC}.gap_m[{sensors - 1}]" in paths
    assert f"{TOPIC}.coil_n[{coils - 1}]" in paths
    assert {f"{TOPIC}.state", f"{TOPIC}.fault"} <= set(paths)


@pytest.mark.parametrize(("coils", "sensors"), [(9, 9), (4, 6)])
def test_plotjuggler_layout_shows_fields_of_the_log(coils: int, sensors: int) -> None:
    root = Xml.fromstring(layouts(coils, sensors)[PLOTJUGGLER])
    names = [curve.attrib["name"] for curve in root.iter("curve")]
    assert len(names) == len(set(names))
    for name in names:
        assert is_field(name.removeprefix(f"{TOPIC}/"), coils, sensors)
    for splitter in root.iter("DockSplitter"):
        assert len(splitter) == int(splitter.attrib["count"])


@pytest.mark.parametrize("name", [FOXGLOVE, PLOTJUGGLER])
def test_shipped_layout_is_that_of_the_shipped_rig(
    name: str, tmp_path: Path, levid: Callable
) -> None:
    done = levid("layout", shipped("rigs/loopback.yaml"), "--out", tmp_path)
    assert done.code == 0
    assert name in done.out
    assert (tmp_path / name).read_text() == shipped(f"layouts/{name}").read_text()
