"""Say what commissioning found in words, and write it into a copy of RIG.yaml."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from .commission import Commissioned, CommissionError

_STROKE_OFF = 0.03
_SENSOR_OFF, _COIL_OFF = 0.02, 0.05
"""Relative scale errors that are corrected: well above what a hand at the stops gives, and what
the response of the stops does."""


def problems(found: Commissioned) -> list[str]:
    """Return what forbids a flight: channels that are dead, or of which it is not sure."""
    return [
        *(f"sensor {i} is stuck: its reading never changes" for i in _at(found.stuck)),
        *(
            f"sensor {i} does not follow the platform"
            for i in _at(found.sensors.dead & ~found.stuck)
        ),
        *(f"coil {i} does not move the platform" for i in _at(found.coils.dead)),
        *(f"sensor {i} lies between two places of RIG.yaml" for i in _at(found.sensors.doubtful)),
        *(f"coil {i} acts between two places of RIG.yaml" for i in _at(found.coils.doubtful)),
        *(
            ["the beam moves to negative x where its drives say positive: reverse their direction"]
            if found.beam is not None and found.beam.reversed
            else []
        ),
    ]


def corrections(found: Commissioned, rig: RigConfig) -> list[str]:
    """Return what is corrected in the copy of RIG.yaml, in words; empty if all is right."""
    return [
        *_moved("sensor", found.sensors.place),
        *_moved("coil", found.coils.place),
        *_scaled("sensor", "reads", found.sensors.scale, sensor_scale(found), rig),
        *_scaled("coil", "pushes", found.coils.gain, coil_scale(found), rig),
        *(
            f"coil {i}: its measured force is that of channel {k}: check the wiring of the "
            "current sensors, which RIG.yaml cannot correct"
            for i, k in enumerate(found.readback)
            if k not in (i, -1)
        ),
    ]


def sensor_scale(found: Commissioned) -> list[float]:
    """Return the scale of each sensor for RIG.yaml: 1 unless it is clearly another one.

    A scale that is common to all is that of the stroke, which is known no better than the stops
    yield under a hand, unless it is large.
    """
    scale = found.sensors.scale
    common = float(np.median(np.abs(scale[scale != 0.0])))
    return _rounded(scale / common if abs(common - 1.0) < _STROKE_OFF else scale, _SENSOR_OFF)


def coil_scale(found: Commissioned) -> list[float]:
    """Return the scale of each coil for RIG.yaml, relative to the median."""
    return _rounded(found.coils.gain, _COIL_OFF)


def corrected_text(text: str, found: Commissioned, rig: RigConfig) -> str:
    """Return the text of RIG.yaml with the places and scales that were found; comments stay.

    Raises:
        CommissionError: the geometry is not written as lists in brackets.
    """
    geometry = rig.geometry
    sensors = _order(found.sensors.place)
    coils = _order(found.coils.place)
    lists = {
        "coil_x_m": np.array(geometry.coil_x_m)[coils],
        "coil_y_m": np.array(geometry.coil_y_m)[coils],
        "sensor_x_m": np.array(geometry.sensors_x_m)[sensors],
        "sensor_y_m": np.array(geometry.sensors_y_m)[sensors],
    }
    for key, values in lists.items():
        listed = ", ".join(f"{v:g}" for v in values)
        pattern = re.compile(rf"^(\s+){key}: \[[^\]]*\]", re.MULTILINE)
        if pattern.search(text):
            text = pattern.sub(rf"\g<1>{key}: [{listed}]", text, count=1)
            continue
        after = re.compile(r"^(\s+)coil_y_m: \[[^\]]*\].*\n", re.MULTILINE)
        match = after.search(text)
        if match is None:
            raise CommissionError(
                "RIG.yaml: expected geometry with coil_x_m and coil_y_m as lists in brackets"
            )
        text = f"{text[: match.end()]}{match[1]}{key}: [{listed}]\n{text[match.end() :]}"
    scales = {"sensor_scale": sensor_scale(found), "coil_scale": coil_scale(found)}
    text = re.sub(r"^channels:.*\n(?:[ \t]+.*\n)*", "", text, flags=re.MULTILINE)
    lines = [f"  {key}: [{', '.join(f'{v:g}' for v in values)}]" for key, values in scales.items()]
    return "\n".join([text.rstrip("\n"), "", "channels: # by levid commission", *lines, ""])


def write_corrected(path: Path, text: str) -> None:
    """Write a new RIG.yaml; raises CommissionError if the file exists."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise CommissionError(f"{path}: exists; a rig is never written over") from None


def _order(place: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a place for each channel: those left over for the channels without one."""
    found = place.copy()
    left = [p for p in range(len(place)) if p not in set(place.tolist())]
    found[found < 0] = left
    return found


def _at(mask: NDArray[np.bool_]) -> Sequence[int]:
    return np.flatnonzero(mask).tolist()


def _moved(what: str, place: NDArray[np.int64]) -> Iterator[str]:
    for channel, found in enumerate(place):
        if found not in (channel, -1):
            yield f"{what} channel {channel} is at the place of {found} in RIG.yaml"


def _scaled(
    what: str, does: str, raw: NDArray[np.float64], used: Sequence[float], rig: RigConfig
) -> Iterator[str]:
    before = getattr(rig.channels, f"{what}_scale") or (1.0,) * len(used)
    for channel, (scale, value) in enumerate(zip(used, raw, strict=True)):
        if scale == 1.0 or value == 0.0:
            continue
        parts = ["with the wrong sign"] if scale < 0.0 else []
        parts += [f"{abs(value):.3g} times as much as it should"] if abs(scale) != 1.0 else []
        kept = f" (RIG.yaml has a scale of {before[channel]:g})" if before[channel] != 1.0 else ""
        yield f"{what} channel {channel} {does} {', '.join(parts)}{kept}"


def _rounded(scale: NDArray[np.float64], off: float) -> list[float]:
    """Return scales with four digits; 1 or -1 where they do not differ clearly, 1 for dead ones."""
    found = []
    for value in scale:
        if value == 0.0:
            found.append(1.0)
        elif abs(abs(value) - 1.0) <= off:
            found.append(float(np.sign(value)))
        else:
            found.append(float(f"{value:.4g}"))
    return found
