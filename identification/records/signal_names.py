"""Names and units of a plant's inputs and outputs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SignalNames:
    """Names and units of inputs and outputs, and their sampling time."""

    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    Ts_s: float
