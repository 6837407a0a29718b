"""Identify a textbook oscillator from 3 s of data: fit, and coverage of the intervals of its mode.

6.75 Hz, damping ratio 0.0189, 1 kHz, white force held over each row, and measurement noise of
0.16 % of the output, so that the true model fits 99.84 %. Each seed draws other data. The poles of
the simulating model are compared with the truth; the intervals are those that `identify` reports.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.signal import cont2discrete, lfilter

from levid.benchmarks.harness.benchmark_runner import Figure, Target, run
from levid.identification.identify import identify
from levid.identification.records.record import Record
from levid.identification.results import OpenLoopPoint
from levid.identification.subspace.response_uncertainty import SURE_95

FREQUENCY_HZ, DAMPING = 6.75, 0.0189
Ts_S, ROWS = 1e-3, 3000
NOISE = 0.0016
SEEDS, QUICK = 200, 10
COVERED = Target(least=90.0, most=98.0)


def record(seed: int) -> Record:
    """Return the record of one seed; the output is a deflection in units of the static one."""
    w, rng = 2 * np.pi * FREQUENCY_HZ, np.random.default_rng(seed)
    num, den, _ = cont2discrete(([w**2], [1.0, 2 * DAMPING * w, w**2]), Ts_S)
    u = rng.normal(size=ROWS)
    y = lfilter(num.ravel(), den, u)
    y += NOISE * y.std() * rng.normal(size=ROWS)
    return Record("oscillator", Ts_S, u[:, None], y[:, None], ("u",), ("N",), ("y",), ("m",))


def measure(quick: bool) -> Iterator[Figure]:
    """Yield the least fit, the coverage of frequency and damping, and the share of order 2."""
    fits, inside, orders = [], [], []
    for seed in range(QUICK if quick else SEEDS):
        (point,) = identify([record(seed)]).points
        assert isinstance(point, OpenLoopPoint)
        fits.append(float(point.holdout[0].simulated_fit_percent[0]))
        orders.append(point.order)
        modes = point.modes
        nearest = int(np.argmin(np.abs(modes.frequency_hz - FREQUENCY_HZ)))
        errors = np.array([modes.frequency_hz[nearest], modes.damping[nearest]])
        errors -= FREQUENCY_HZ, DAMPING
        limits = np.array([modes.frequency_se_hz[nearest], modes.damping_se[nearest]])
        inside.append(np.abs(errors) <= SURE_95 * limits)
    covered = 100.0 * np.mean(inside, axis=0)
    yield Figure("seeds", len(fits), "", "seeds")
    yield Figure(
        "least_fit", min(fits), "%", "least fit of held-out rows", target=Target(least=99.5)
    )
    yield Figure(
        "frequency", covered[0], "%", "intervals that contain the frequency", None, COVERED
    )
    yield Figure("damping", covered[1], "%", "intervals that contain the damping", None, COVERED)
    yield Figure("order_2", 100.0 * float(np.mean(np.array(orders) == 2)), "%", "models of order 2")


if __name__ == "__main__":
    run("A textbook oscillator", measure)
