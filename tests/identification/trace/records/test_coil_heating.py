"""What coils carried through a session, from its records alone."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from levid.identification.trace.records.coil_heating import loads_of


def record(begin_s: float, seconds: float, force_n: float) -> SimpleNamespace:
    rows = round(seconds * 1000)
    coil = np.tile([force_n, 0.0], (rows, 1))
    time_s = begin_s + 1e-3 * np.arange(rows)
    return SimpleNamespace(
        time_s=time_s, coil=coil, rows=rows, experiment=SimpleNamespace(Ts_s=1e-3)
    )


def test_loads_are_of_blocks_in_the_order_of_time_and_change_half_way_between_records() -> None:
    loads = loads_of([record(20.0, 1.0, 3.0), record(5.0, 5.001, 8.0)])
    np.testing.assert_allclose(loads.times_s, [5.0, 7.0, 9.0, 15.0])
    assert loads.squares == ((64.0, 0.0), (64.0, 0.0), (64.0, 0.0), (9.0, 0.0))
