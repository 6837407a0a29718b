"""A CAN reading counts if it came by the deadline, by its stamp, whenever this process looks."""

from __future__ import annotations

import time

import numpy as np
import pytest

from levid.config.buses import CanBus
from levid.drivers.can.link import CanLink
from levid.drivers.can.readings import Readings
from levid.wire.can_bus import open_bus
from levid.wire.can_frames import load_frames

CONFIG = CanBus(interface="virtual", channel="readings", data_bitrate=5_000_000, stale_cycles=2)


@pytest.mark.parametrize("late", [False, True])
def test_reading_that_came_after_its_deadline_is_stale(late: bool) -> None:
    link, device = CanLink("main", CONFIG), open_bus(CONFIG)
    link.open()
    try:
        host, frames, out = (
            Readings("sensors", link, load_frames(None, 9, 9, True).gap, 2),
            load_frames(None, 9, 9, True).gap,
            np.full(9, 7.0),
        )
        host.begin(5)
        deadline_s = time.perf_counter() + (0.0 if late else 3600.0)
        time.sleep(0.01)
        for can_id, data in frames.encode(np.full(9, 1e-4), 5, 0):
            device.send(can_id, data)
        # It is there in either case, and found: what decides is when it came.
        host.collect(deadline_s, out)
        assert host.fresh is not late
        assert host.watch.stale == late
        np.testing.assert_allclose(out, 7.0 if late else 1e-4, atol=2e-8)
    finally:
        link.close()
        device.shutdown()
