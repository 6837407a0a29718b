"""Name the inputs and outputs of a plant, with units and sampling time."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SignalNames:
    """Names and units of inputs and outputs, and the sampling time."""

    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    Ts_s: float
