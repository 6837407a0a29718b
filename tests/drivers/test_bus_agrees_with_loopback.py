"""A session flown over a bus is that of loopback, but for rounding; what is stale is marked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from levid.config.base import parse_text
from levid.config.session import SessionConfig
from levid.daemon.loop.clock import VirtualClock
from levid.daemon.loop.virtual_flight import Flight
from levid.daemon.planning.plan import plan_session
from levid.drivers.base import Devices
from levid.drivers.open_backends import open_devices
from levid.log.reader import read_log
from levid.log.signals import Stale
from levid.sim.electronics.emulated_rig import Electronics

RATE_HZ = 250.0
SESSION = """
levid: session
name: agreement
excitations:
  psi: {input: psi, rms_n_m: 0.05}
  z: {input: z, rms_n: 0.5}
steps:
  - levitate: {settle_s: 0.5}
  - record: {name: both, duration_s: 8, settle_s: 0.5, excite: [psi, z]}
  - land: {}
"""


pytestmark = pytest.mark.usefixtures("host_paced")


def flown(rig, folder: Path, out: Path) -> np.ndarray:
    session = parse_text(SESSION, SessionConfig, "agreement")
    out.mkdir()
    with Flight(rig, folder, RATE_HZ, VirtualClock()) as flight:
        flight.idle(60)  # amplifiers are enabled while zero force is asked for
        plan = plan_session(session, rig, flight.beam_m, flight.rotor_rad)
        result = flight.fly(plan, out, {})
        assert flight.devices.stale == 0
    return read_log(result.records[0]).rows


@pytest.mark.parametrize("bus", ["can", "canfd", "serial"])
def test_session_over_a_bus_is_that_of_loopback(
    bus: str, rig_on, quiet_sim: Path, tmp_path: Path
) -> None:
    rig = rig_on(bus, RATE_HZ, quiet_sim)
    with Electronics(rig, tmp_path):
        found = flown(rig, tmp_path, tmp_path / "bus")
    expected = flown(rig_on("loopback", RATE_HZ, quiet_sim), tmp_path, tmp_path / "loopback")
    assert len(found) == len(expected)
    np.testing.assert_array_equal(found["v_psi_n_m"], expected["v_psi_n_m"])
    moved_m = expected["gap_m"].std()
    off_m = np.sqrt(np.mean(np.square(found["gap_m"] - expected["gap_m"])))
    # Forces are rounded to 1 mN: 0.29 mN rms a coil, white, 0.87 mN on z. Held for T = 4 ms on
    # mass and rods that is sqrt(F^2 T / (2 c k)) with c = 36 N s/m, k = 2600 N/m: 0.13 um; tilts
    # add 0.07 um at a corner. Three times that allows for damping that the loop's delay takes.
    assert off_m < 3 * 0.15e-6
    assert moved_m > 50e-6  # it did move: the comparison says something


@pytest.mark.parametrize("bus", ["canfd", "serial"])
def test_rows_with_an_earlier_reading_say_so(
    bus: str, rig_on, quiet_sim, tmp_path, patience, monkeypatch
) -> None:
    rig = rig_on(bus, RATE_HZ, quiet_sim)
    dropped = [70, 90, 91]
    with Electronics(rig, tmp_path) as electronics:

        class Dropping(Devices):
            @property
            def syncs(self):  # type: ignore[no-untyped-def]
                return (self.drop_and_sync,)

            def drop_and_sync(self, cycle: int, late_s: float = 0.0) -> None:
                lost = cycle in dropped
                electronics.injector.command("drop" if lost else "clear")
                # The wait is short only where no answer comes.
                patience.seconds = 0.1 if lost else 30.0
                (backend,) = self.backends
                backend.sync(cycle)

        monkeypatch.setattr(
            "levid.daemon.loop.virtual_flight.open_devices",
            lambda context: Dropping(*vars(open_devices(context)).values()),
        )
        with Flight(rig, tmp_path, RATE_HZ, VirtualClock()) as flight:
            flight.idle(120)
            rows = flight._ring.rows[:120].copy()
    everything = Stale.SENSORS | Stale.AMPLIFIERS | Stale.DRIVES
    assert np.flatnonzero(rows["stale"]).tolist() == dropped
    assert set(rows["stale"][dropped]) == {everything}
    np.testing.assert_array_equal(rows["gap_m"][dropped], rows["gap_m"][[69, 89, 89]])
