"""Test coil loads of a session, computed from its records."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from levid.identification.trace.records.coil_load_history import loads_of
from levid.model.effects.coil_drift import carried


def record(begin_s: float, seconds: float, force_n: float) -> SimpleNamespace:
    rows = round(seconds * 1000)
    coil = np.tile([force_n, 0.0], (rows, 1))
    time_s = begin_s + 1e-3 * np.arange(rows)
    return SimpleNamespace(
        time_s=time_s, coil=coil, rows=rows, experiment=SimpleNamespace(Ts_s=1e-3)
    )


def test_coil_loads_are_block_means_in_order_of_time() -> None:
    loads = loads_of([record(20.0, 1.0, 3.0), record(5.0, 5.001, 8.0)])
    np.testing.assert_allclose(loads.times_s, [5.0, 7.0, 9.0, 10.0, 15.0, 20.0])
    # Between records, the first half of the time has the load before, the other the load after.
    assert [square for square, _ in loads.squares] == [64.0, 64.0, 64.0, 64.0, 9.0, 9.0]
    assert loads.between == (False, False, False, True, True, False)


def test_an_actuator_that_rests_between_records_cools_down_there() -> None:
    loads = loads_of([record(5.0, 5.001, 8.0), record(20.0, 1.0, 3.0)])
    later = SimpleNamespace(
        time_s=np.array([20.0]), coil=np.array([[3.0]]), places=SimpleNamespace(loads=loads)
    )
    tau_s = 4.0
    warm = 64.0 * (1.0 - np.exp(-5.0 / tau_s))
    assert carried(later, 0, tau_s, 0.0, rests=True) == pytest.approx(warm * np.exp(-10.0 / tau_s))
    held = warm * np.exp(-10.0 / tau_s)
    held += 64.0 * (np.exp(-5.0 / tau_s) - np.exp(-10.0 / tau_s)) + 9.0 * (
        1.0 - np.exp(-5.0 / tau_s)
    )
    assert carried(later, 0, tau_s, 0.0) == pytest.approx(held)
