"""Hold an identified plant in state space with names and units, and its modes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..identification.value_with_interval import value_with_interval
from .html_table import Table
from .model import Parameter
from .read_only_arrays import read_only

if TYPE_CHECKING:
    import control
    from scipy.signal import StateSpace as ScipyStateSpace

    from ..identification.records.signal_names import SignalNames
    from ..model.second_order import StateSpace

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mode:
    """A pole pair: natural frequency in Hz and damping ratio, with standard errors.

    A real pole has damping 1 (unstable: -1). `beam_m`: beam position of the records, None without.
    """

    frequency: Parameter
    damping: Parameter
    beam_m: float | None = None

    def __str__(self) -> str:
        return f"{self.frequency}, {self.damping}"


class Modes(tuple[Mode, ...]):
    """The modes of an identification; displays as a table."""

    __slots__ = ()

    def __repr__(self) -> str:
        return self._table().text() if self else "no modes with standard errors"

    def _repr_html_(self) -> str:
        return self._table().html()

    def _table(self) -> Table:
        rows = [
            (
                "" if m.beam_m is None else beam_text(m.beam_m),
                f"{value_with_interval(m.frequency.value, m.frequency.se, '±')} Hz",
                value_with_interval(m.damping.value, m.damping.se, "±"),
            )
            for m in self
        ]
        return Table(("beam", "frequency, 95 % interval", "damping, 95 % interval"), rows)


@dataclass(frozen=True)
class Plant:
    """A plant x+ = A x + B u, y = C x + D u, with delay and lag as states.

    `Ts_s` is 0 for a continuous model, which then has the separate input delay `delay_s`. `method`:
    how it was identified. `beam_m`: the beam position, None without a beam. The matrices are
    read-only.
    """

    method: str
    A: Array
    B: Array
    C: Array
    D: Array
    Ts_s: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    beam_m: float | None = None
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("A", "B", "C", "D"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def response(self, freq_hz: NDArray[np.floating]) -> NDArray[np.complex128]:
        """Return the frequency response (F, outputs, inputs) at freq_hz (F,) in Hz."""
        at_hz = np.atleast_1d(np.asarray(freq_hz, np.float64))
        return self._state_space().response(at_hz, self.delay_s)

    def poles(self) -> NDArray[np.complex128]:
        """Return the eigenvalues of A."""
        return np.asarray(np.linalg.eigvals(self.A), np.complex128)

    def to_control(self) -> control.StateSpace:
        """Return a python-control StateSpace with the names of inputs and outputs.

        Raises:
            ImportError: python-control is not installed.
            ValueError: a continuous model with a delay, which a StateSpace cannot express.
        """
        from ..identification.export import control_state_space

        self._no_delay()
        return control_state_space(self._state_space(), self._names())

    def to_scipy(self) -> ScipyStateSpace:
        """Return a scipy.signal.StateSpace; raises ValueError for a continuous one with a delay."""
        from ..identification.export import scipy_state_space

        self._no_delay()
        return scipy_state_space(self._state_space())

    def _state_space(self) -> StateSpace:
        from ..model.second_order import StateSpace

        return StateSpace(self.A, self.B, self.C, self.D, self.Ts_s)

    def _names(self) -> SignalNames:
        from ..identification.records.signal_names import SignalNames

        return SignalNames(
            self.inputs, self.input_units, self.outputs, self.output_units, self.Ts_s
        )

    def _no_delay(self) -> None:
        if self.delay_s:
            raise ValueError(
                f"expected a plant without a separate delay, found {self.delay_s:g} s: use A, B, "
                "C, D and delay_s, or method='recommended'"
            )

    def __repr__(self) -> str:
        time = f"Ts = {self.Ts_s:g} s" if self.Ts_s else f"continuous, delay {self.delay_s:g} s"
        at = "" if self.beam_m is None else f", beam at {beam_text(self.beam_m)}"
        return (
            f"<Plant by {self.method}: {len(self.A)} states, {', '.join(self.inputs)} -> "
            f"{', '.join(self.outputs)}, {time}{at}>"
        )


def beam_text(beam_m: float) -> str:
    """Return a beam position in mm with its sign, and none at zero."""
    text = f"{1e3 * beam_m:+.1f}"
    return f"{text[1:] if float(text) == 0.0 else text} mm"


def plant_of(
    method: str,
    model: StateSpace,
    signals: SignalNames,
    beam_m: float | None,
    delay_s: float = 0.0,
) -> Plant:
    """Return a plant from matrices and names."""
    return Plant(
        method, model.A, model.B, model.C, model.D, model.Ts_s,
        signals.input_names, signals.output_names, signals.input_units, signals.output_units,
        beam_m, delay_s,
    )  # fmt: skip
