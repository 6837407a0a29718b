"""Say what commissioning found in words, and write it into a copy of RIG.yaml."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...config.files.atomic_write import write_file
from ...config.model import ModelConfig
from ...config.rig import RigConfig
from ...identification.greybox.declared_model_from_config import declared_model
from ..control.watchdog_times import fall_s
from .commission import Commissioned
from .errors import CommissionError

_STROKE_OFF, _BEAM_OFF = 0.03, 0.2
_HOVER, _WEIGHT, _ROOM = 2.5, 1.25, 0.5
"""Limits of a first lift: coil force over its share of the weight, total force over the weight,
tilt and speed over their own limits."""
_CYCLES = 2.0
"""From a command to a reading: it acts from the next cycle on, which is read at its end."""
_LATE_CYCLES, _SURE = 0.5, 4.0
"""Difference from the model's delay, in cycles and in standard deviations, that is a remark: the
rise of the stops is part of the measured delay."""
_LIMITS = re.compile(r"^limits:[ \t]*(?:#.*)?\n(?:[ \t]+.*\n|#.*\n|[ \t]*\n)+", re.MULTILINE)
_INDENT = re.compile(r"^([ \t]+)[^\s#]", re.MULTILINE)
_SENSOR_OFF, _COIL_OFF = 0.02, 0.05
"""Relative scale errors that are corrected: well above what a hand at the stops gives, and what
the response of the stops does."""


def problems(found: Commissioned) -> list[str]:
    """Return what forbids a flight: channels that are dead, or of which it is not sure."""
    common = common_scale(found)
    return [
        *(f"sensor {i} is stuck: its reading never changes" for i in _at(found.stuck)),
        *(
            f"sensor {i} does not follow the platform"
            for i in _at(found.sensors.dead & ~found.stuck)
        ),
        *(f"coil {i} moves the platform too little, or not at all" for i in _at(found.coils.dead)),
        *(
            f"coil {i}: its measured force is that of channel {k}: check the wiring of the "
            "current sensors, which RIG.yaml cannot correct"
            for i, k in enumerate(found.readback)
            if k not in (i, -1)
        ),
        *(f"sensor {i} lies between two places of RIG.yaml" for i in _at(found.sensors.doubtful)),
        *(f"coil {i} acts between two places of RIG.yaml" for i in _at(found.coils.doubtful)),
        *(
            [f"all sensors read {common:.3g} times as much as they should: is the stroke right?"]
            if abs(common - 1.0) >= _STROKE_OFF
            else []
        ),
        *(
            ["the beam moves to negative x where its drives say positive: reverse their direction"]
            if found.beam is not None and found.beam.reversed
            else []
        ),
        *filter(None, (encoder.problem for encoder in found.encoders)),
    ]


def remarks(found: Commissioned, rig: RigConfig) -> list[str]:
    """Return what is worth knowing, and forbids nothing."""
    beam = found.beam
    return [
        *(
            f"sensor {i} rests at the end of its range: its place and scale were found from the "
            "readings within it"
            for i in _at(found.resting.clipped & ~found.sensors.dead)
        ),
        *(
            [
                f"the beam tilts the platform {abs(beam.ratio):.2g} times as much as its declared "
                "weight and the coils say: all coils together, the model's m_b or the encoder is "
                "off by that"
            ]
            if beam is not None and beam.sure and abs(abs(beam.ratio) - 1.0) > _BEAM_OFF
            else []
        ),
        *(
            f"the motion of the {encoder.axis} was not measured by hand: its scale is not checked"
            for encoder in found.encoders
            if encoder.scale is None
        ),
        *_late(found, rig),
    ]


def _late(found: Commissioned, rig: RigConfig) -> Iterator[str]:
    """Yield a remark if heights answer at another time than the declared model says."""
    model, delay = rig.model, found.height_delay
    if not isinstance(model, ModelConfig):
        return
    at = declared_model(model).at()
    declared_s = max(at.delay_s, 0.0) + max(at.lag_s, 0.0) + _CYCLES / rig.rate_hz
    off_s = delay.mean_s - declared_s
    if abs(off_s) > max(_LATE_CYCLES / rig.rate_hz, _SURE * delay.sd_s):
        yield (
            f"heights answer {1e3 * delay.mean_s:.3g} ms after a coil's command; the model's delay "
            f"and lag make it {1e3 * declared_s:.3g} ms: the difference belongs to them"
        )


def common_scale(found: Commissioned) -> float:
    """Return the median scale of the sensors that follow: the stroke's error, and the stops' sag.

    Sensors of half of all channels are right in it.
    """
    scale = found.sensors.scale
    return float(np.median(np.abs(scale[scale != 0.0])))


def corrections(found: Commissioned) -> list[str]:
    """Return what is corrected in the copy of RIG.yaml, in words; empty if all is right."""
    return [
        *_moved("sensor", found.sensors.place),
        *_moved("coil", found.coils.place),
        *_scaled("sensor", "reads", sensor_scale(found)),
        *_scaled("coil", "pushes", coil_scale(found)),
    ]


def sensor_scale(found: Commissioned) -> list[float]:
    """Return the scale of each sensor against RIG.yaml: 1 unless it is clearly another one.

    What is common to all is that of the stroke: it is known no better than stops yield by a hand.
    """
    return _rounded(found.sensors.scale / common_scale(found), _SENSOR_OFF)


def coil_scale(found: Commissioned) -> list[float]:
    """Return the scale of each coil for RIG.yaml, relative to the median."""
    return _rounded(found.coils.gain, _COIL_OFF)


def corrected_text(text: str, found: Commissioned, rig: RigConfig) -> str:
    """Return the text of RIG.yaml with the places and scales that were found; comments stay.

    `check_text` says whether the text can be corrected.
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
        assert match is not None
        text = f"{text[: match.end()]}{match[1]}{key}: [{listed}]\n{text[match.end() :]}"
    # The channels were read and driven with the scales that RIG.yaml has already.
    scales = {
        "sensor_scale": _times(sensor_scale(found), rig.channels.sensor_scale),
        "coil_scale": _times(coil_scale(found), rig.channels.coil_scale),
    }
    text = re.sub(r"^channels:.*(?:\n(?:[ \t].*)?(?=\n|\Z))*", "", text, flags=re.MULTILINE)
    lines = [f"  {key}: [{', '.join(f'{v:g}' for v in values)}]" for key, values in scales.items()]
    return "\n".join([text.rstrip("\n"), "", "channels: # by levid commission", *lines, ""])


def first_lift_text(text: str, rig: RigConfig, weight_n: float) -> str:
    """Return the text of a RIG.yaml with limits for a first lift: half of the room, little force.

    The forces suffice to hover and to correct; a wrong sign that commissioning did not see ends the
    lift-off before the platform is fast. Limits that are tighter already stay. A rig that limits
    neither tilt nor speed has room for that of the gap at the longest arm, and of a fall by it.
    weight_n: of the platform in N.
    """
    limits, geometry = rig.limits, rig.geometry
    arm_m = max(map(abs, (*geometry.coil_x_m, *geometry.coil_y_m)))
    tight = {
        "coil_n": _HOVER * weight_n / len(geometry.coil_x_m),
        "total_n": _WEIGHT * weight_n,
        "tilt_rad": _ROOM * (limits.tilt_rad or limits.gap_m / arm_m),
        "gap_m_s": _ROOM * (limits.gap_m_s or 2.0 * limits.gap_m / fall_s(rig)),
    }
    found = _LIMITS.search(text)
    assert found is not None
    block = found[0]
    for key, most in tight.items():
        own = getattr(limits, key)
        value = most if own is None else min(most, own)
        line = re.compile(rf"^(\s+){key}: [^\s#]+", re.MULTILINE)
        if line.search(block):
            block = line.sub(rf"\g<1>{key}: {value:.4g}", block, count=1)
        else:
            head, _, rest = block.partition("\n")
            indent = _INDENT.search(rest)
            block = f"{head}\n{indent[1] if indent else '  '}{key}: {value:.4g}\n{rest}"
    text = f"{text[: found.start()]}{block}{text[found.end() :]}"
    return f"# For the first lift only: tight limits, by levid commission.\n{text}"


def check_text(text: str, name: str) -> None:
    """Raise CommissionError for a RIG.yaml whose text could not be corrected or tightened."""
    for key in ("coil_x_m", "coil_y_m"):
        if re.search(rf"^\s+{key}: \[[^\]]*\]", text, re.MULTILINE) is None:
            raise CommissionError(
                f"{name}: geometry.{key}: expected a list in brackets on a line of its own, which "
                f"`levid commission` can correct: `  {key}: [0.12, ...]`"
            )
    if _LIMITS.search(text) is None:
        raise CommissionError(
            f"{name}: limits: expected one key on a line, which `levid commission` can tighten for "
            "the first lift: `  coil_n: 20`"
        )


def write_corrected(path: Path, text: str) -> None:
    """Write a new RIG.yaml; raises CommissionError if the file exists."""
    try:
        write_file(path, text, replace=False)
    except FileExistsError:
        raise CommissionError(
            f"{path}: exists; levid overwrites no rig: give another path"
        ) from None


def _order(place: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a place for each channel: those left over for the channels without one."""
    found = place.copy()
    left = [p for p in range(len(place)) if p not in set(place.tolist())]
    found[found < 0] = left
    return found


def _at(mask: NDArray[np.bool_]) -> Sequence[int]:
    return np.flatnonzero(mask).tolist()


def _moved(what: str, place: NDArray[np.int64]) -> Iterator[str]:
    for channel, found in enumerate(place.tolist()):
        if found in (channel, -1):
            continue
        if place[found] != channel:
            yield f"{what} channel {channel} is at the place of {found} in RIG.yaml"
        elif channel < found:
            yield f"{what} channels {channel} and {found} are swapped in RIG.yaml"


def _scaled(what: str, does: str, scales: Sequence[float]) -> Iterator[str]:
    for channel, scale in enumerate(scales):
        if scale == 1.0:
            continue
        parts = ["with the wrong sign"] if scale < 0.0 else []
        parts += [f"{abs(scale):.3g} times as much as it should"] if abs(scale) != 1.0 else []
        yield f"{what} channel {channel} {does} {', '.join(parts)}"


def _times(found: Sequence[float], before: Sequence[float]) -> list[float]:
    return [float(f"{a * b:.4g}") for a, b in zip(found, before or [1.0] * len(found), strict=True)]


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
