"""Test coil loads of a session, computed from its records."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from levid.identification.trace.records.coil_load_history import loads_of


def record(begin_s: float, seconds: float, force_n: float) -> SimpleNamespace:
    rows = round(seconds * 1000)
    coil = np.tile([force_n, 0.0], (rows, 1))
    time_s = begin_s + 1e-3 * np.arange(rows)
    return SimpleNamespace(
        time_s=time_s, coil=coil, rows=rows, experiment=SimpleNamespace(Ts_s=1e-3)
    )


def test_coil_loads_are_block_means_in_order_of_time() -> None:
    loads = loads_of([record(20.0, 1.0, 3.0), record(5.0, 5.001, 8.0)])
    np.testing.assert_allclose(loads.times_s, [5.0, 7.0, 9.0, 15.0])
    assert loads.squares == ((64.0, 0.0), (64.0, 0.0), (64.0, 0.0), (9.0, 0.0))
