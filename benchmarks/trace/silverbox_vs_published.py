"""Silverbox: error of the laws that the trace finds, beside an output-error fit and published ones.

The laws of position and speed are searched in the prediction errors of seven eighths of the usual
training data. The error is that of a free run of the test data, from 5 s on, which set the state
and the constant force; the arrow's noise grows beyond the amplitude of the training data. In the
same run, an oscillator with a square and a cube of its position is fitted by its output error,
without code of levid. The published errors are of the arrow; which rows they count was not checked.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray
from rich.table import Table
from scipy.optimize import least_squares
from scipy.signal import resample

from levid.benchmarks.harness import silverbox
from levid.benchmarks.harness.benchmark_runner import Figure, Target, parser, show
from levid.config.model import load_model
from levid.identification.trace.run_trace import trace
from levid.identification.trace.worker_pool import Alone

Array = NDArray[np.float64]

PARTS, ROWS = 7, 8192
TESTS = {
    "multisine": silverbox.TEST,
    "arrow": (100, 40_574),
    "arrow, no extrapolation": (101, 32_099),
}
FINER = 8
"""Steps of the integration in a row, of which the fourth-order rule takes two at a time."""


class Published(NamedTuple):
    """A published model: what it is, its numbers, its error on the arrow in mV, and the source."""

    what: str
    numbers: int
    arrow_mv: float
    source: str


PUBLISHED = (
    Published("linear, best approximation", 5, 13.7, "Paduart 2008"),
    Published("multilayer perceptron", 600, 7.8, "Sragner and others 2004"),
    Published("local linear state space", 16, 1.3, "Verdult 2004"),
    Published("oscillator, by relaxation", 5, 0.96, "Hjalmarsson and Schoukens 2004"),
    Published(
        "linear block with cubic feedback, output error", 10, 0.38, "Paduart and others 2004"
    ),
    Published("polynomial feedback, output error", 11, 0.35, "Van Mulders and others 2011"),
    Published("sigmoidal neural state space", 23, 0.34, "Marconato and others 2012"),
    Published("support vectors, NARX", 490, 0.32, "Espinoza and others 2004"),
    Published("sigmoidal network, NARX", 712, 0.30, "Ljung and others 2004"),
    Published("polynomial state space, output error", 37, 0.26, "Paduart 2008"),
)
"""As quoted by others, mostly from A. Van Mulders' thesis; the sources were not at hand."""


def _oscillate(
    u: Array, start: Array, numbers: Array, rows: int, steps: int, h: float
) -> Array:  # pragma: no cover - compiled
    b, d, k, k2, k3 = numbers
    y, q, v = np.empty(rows), start[0], start[1]
    for row in range(rows):
        y[row] = q
        for step in range(0, steps, 2):
            at = row * steps + step
            p, w, total_v, total_a = q, v, 0.0, 0.0
            for stage in range(4):
                force = u[at + (0, 1, 1, 2)[stage]]
                a = b * force - d * w - k * p - k2 * p * p - k3 * p**3
                weight = (1.0, 2.0, 2.0, 1.0)[stage] / 6.0
                total_v, total_a = total_v + weight * w, total_a + weight * a
                ahead = (h, h, 2.0 * h, 0.0)[stage]
                p, w = q + ahead * w, v + ahead * a
            q, v = q + 2.0 * h * total_v, v + 2.0 * h * total_a
    return y


_oscillated = cast("Callable[..., Array]", njit(cache=True)(_oscillate))


class Oscillator:
    """An oscillator with gain, damping, stiffness, square and cube (5,), and an offset in V."""

    def __init__(self) -> None:
        self._volts = np.loadtxt(silverbox.SOURCE, delimiter=",", skiprows=1, usecols=(0, 1))
        self._Ts_s = 2**14 / 1e7
        self._scale = np.array([1.8e5, 40.0, 1.8e5, 1e4, 1e5, 1e-2, 1e-2, 1.0])

    def fitted(self, first: int, last: int) -> Array:
        """Return the numbers (6,) that leave least of the output of some rows, started at 1."""
        begin = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        found = least_squares(lambda x: self._error(x * self._scale, first, last), begin)
        return np.asarray(found.x * self._scale)[:6]

    def error_mv(self, numbers: Array, first: int, last: int, settled_s: float) -> float:
        """Return the RMS error in mV behind a time in which the state at the begin is estimated."""
        rows = round(settled_s / self._Ts_s)

        def early(x: Array) -> Array:
            return self._error(np.concatenate([numbers, x * self._scale[6:]]), first, first + rows)

        state = least_squares(early, np.zeros(2)).x * self._scale[6:]
        error = self._error(np.concatenate([numbers, state]), first, last)[rows:]
        return 1e3 * float(np.sqrt(np.mean(error**2)))

    def _error(self, x: Array, first: int, last: int) -> Array:
        u, y = self._volts[first : last + 1].T
        # Mirrored, the band-limited input has no jump at its ends.
        finer = resample(np.concatenate([u, u[::-1]]), 2 * len(u) * FINER)[: (len(u) + 1) * FINER]
        own = _oscillated(finer, x[6:], x[:5], len(u), FINER, self._Ts_s / FINER)
        return np.asarray(own + x[5] - y)


def main() -> None:
    """Trace, fit, and print the errors."""
    arguments = parser("Silverbox beside published errors; --quick: three parts").parse_args()
    table = Table("model", "numbers", "arrow, mV", "source")
    parts = 3 if arguments.quick else PARTS

    def measure() -> Iterator[Figure]:
        if not silverbox.SOURCE.exists():
            return
        config = load_model(silverbox.MODEL)
        begin = silverbox.TRAIN[0]
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            rows = [(begin + i * ROWS, begin + (i + 1) * ROWS - 1) for i in range(parts)]
            logs = [silverbox.imported(r, folder) for r in rows]
            found = trace(logs, config, silverbox.laws_of_motion, Alone(config), lambda *_: None)
            point = found.found.point
            unseen = {test: silverbox.imported(r, folder) for test, r in TESTS.items()}
            errors = {
                test: 1e3 * silverbox.free_run_error(point, log) for test, log in unseen.items()
            }
            linear = 1e3 * silverbox.free_run_error(found.declared, unseen["arrow"])
        laws = ", ".join(p.effect.key for p in point.placed)
        numbers = len(config.parameters)
        count = numbers + sum(len(p.amplitudes) + len(p.shape) for p in point.placed)
        table.add_row("levid, linear", str(numbers), f"{linear:.3g}", "this run")
        table.add_row(f"levid: {laws}", str(count), f"{errors['arrow']:.3g}", "this run")
        oscillator = Oscillator()
        fit = oscillator.fitted(begin, begin + parts * ROWS - 1)
        alone = {k: oscillator.error_mv(fit, *r, settled_s=5.0) for k, r in TESTS.items()}
        table.add_row("oscillator, output error", "6", f"{alone['arrow']:.3g}", "this run")
        for one in sorted(PUBLISHED, key=lambda p: p.arrow_mv):
            table.add_row(one.what, str(one.numbers), f"{one.arrow_mv:g}", one.source)
        yield Figure("linear_mv", linear, "mV", "linear model, arrow")
        for key, error in errors.items():
            target = Target(most=0.24) if key == "multisine" else None
            yield Figure(f"{key}_mv", error, "mV", f"laws found, {key}", target=target)
            yield Figure(f"{key}_output_error_mv", alone[key], "mV", f"output-error fit, {key}",
                         versus=f"{key}_mv")  # fmt: skip

    show("Silverbox", arguments, measure, lambda: [table])


if __name__ == "__main__":
    main()
