"""What every backend must do, whatever it is made of: one suite for all of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from waiting import wait_until

from levid.config.rig import RigConfig
from levid.daemon.control.control_cycle import Controller
from levid.daemon.loop.prepare_first_cycle import locate
from levid.drivers.base import Context, Devices
from levid.drivers.open_backends import open_devices
from levid.sim.electronics.emulated_rig import Electronics

BACKENDS = ["loopback", "can", "canfd", "canlocal", "serial"]
RATE_HZ = 100.0
# A reading is rounded to 31 nm on the wire and in the converter, a force to 1 mN, which moves the
# platform by 1 mN / (2600 N/m) = 0.4 um at most per coil that is off by half of it.
GAP_TOLERANCE_M = 2e-6
FORCE_TOLERANCE_N = 1e-3
# Counts of 1 nm, and differences of four of them at 100 Hz.
BEAM_TOLERANCE_M = 2e-8


pytestmark = pytest.mark.usefixtures("host_paced")


@dataclass
class Bench:
    """Devices open and ready, cycle by cycle."""

    devices: Devices
    rig: RigConfig
    electronics: Electronics | None
    cycle: int = -1

    def __post_init__(self) -> None:
        coils, sensors = len(self.rig.geometry.coil_x_m), len(self.rig.geometry.sensors_x_m)
        self.coil_n, self.gap_m, self.readback_n = (np.zeros(n) for n in (coils, sensors, coils))
        self.beam, self.rotor = np.zeros(3), np.zeros(3)
        self.beam_ref, self.rotor_ref = np.zeros(3), np.zeros(3)

    def run(self, cycles: int = 1, skip: int = 0) -> None:
        """Read and write as the loop does; `skip` periods first."""
        devices = self.devices
        for _ in range(cycles):
            self.cycle += 1 + skip
            for sync in devices.syncs:
                sync(self.cycle)
            devices.sensors.read(self.gap_m)
            devices.drives.read(self.beam, self.rotor)
            devices.amplifiers.read(self.readback_n)
            devices.amplifiers.write(self.coil_n)
            devices.drives.write(self.beam_ref, self.rotor_ref)


@pytest.fixture(params=BACKENDS)
def bench(request, rig_on, quiet_sim: Path) -> Iterator[Bench]:
    with ExitStack() as stack:
        yield made(request.param, rig_on, quiet_sim, stack)


@pytest.fixture
def loopback(rig_on, quiet_sim: Path) -> Iterator[Bench]:
    with ExitStack() as stack:
        yield made("loopback", rig_on, quiet_sim, stack)


def made(bus: str, rig_on, sim: Path, stack: ExitStack) -> Bench:
    rig = rig_on(bus, RATE_HZ, sim, expire_cycles=3)
    electronics = None
    if bus != "loopback":
        electronics = stack.enter_context(Electronics(rig, sim.parent))
    devices = open_devices(Context(rig, 1 / RATE_HZ, sim.parent))
    stack.callback(devices.close)
    bench = Bench(devices, rig, electronics)
    bench.run(60)  # amplifiers are enabled while zero force is asked for
    return bench


def both(bench: Bench, loopback: Bench, cycles: int, skip: int = 0) -> tuple[list, list]:
    """Run both and return their gaps and forces, a row a cycle."""
    seen: tuple[list, list] = ([], [])
    for _ in range(cycles):
        for one, rows in zip((bench, loopback), seen, strict=True):
            one.run(1, skip)
            rows.append(np.concatenate([one.gap_m, one.readback_n]))
    return seen


def test_force_of_a_cycle_acts_from_the_next_on(bench: Bench, loopback: Bench) -> None:
    for one in (bench, loopback):
        one.coil_n[:] = 7.0
    found, expected = both(bench, loopback, 12)
    np.testing.assert_allclose(
        np.array(found)[:, :9], np.array(expected)[:, :9], atol=GAP_TOLERANCE_M
    )
    # Written in the first cycle, taken over at the sync of the second, read back at the third.
    forces = np.array(found)[:, 9:]
    assert np.abs(forces[:2]).max() < FORCE_TOLERANCE_N
    np.testing.assert_allclose(forces[3], 7.0, atol=FORCE_TOLERANCE_N)


def test_every_coil_and_every_sensor_is_its_own(bench: Bench, loopback: Bench) -> None:
    for one in (bench, loopback):
        one.coil_n[:] = 7.5 + 0.1 * np.arange(9)
    found, expected = both(bench, loopback, 10)
    np.testing.assert_allclose(
        np.array(found)[:, :9], np.array(expected)[:, :9], atol=GAP_TOLERANCE_M
    )
    np.testing.assert_allclose(bench.readback_n, bench.coil_n, atol=FORCE_TOLERANCE_N)
    lifted = bench.gap_m.reshape(3, 3)
    assert np.ptp(lifted) > 10 * GAP_TOLERANCE_M  # it does tilt: the comparison says something


def test_periods_that_were_skipped_have_passed(bench: Bench, loopback: Bench) -> None:
    for one in (bench, loopback):
        one.coil_n[:] = 7.8
    found, expected = both(bench, loopback, 4, skip=1)
    np.testing.assert_allclose(
        np.array(found)[:, :9], np.array(expected)[:, :9], atol=GAP_TOLERANCE_M
    )


@pytest.mark.parametrize("anew", ["opened by the next process", "recovered"])
def test_whoever_comes_to_a_manipulator_leaves_it_where_it_is(
    bench: Bench, anew: str, rig_on, quiet_sim: Path
) -> None:
    """Somebody may have moved it by hand, or the loop before this one was killed in flight."""
    if bench.electronics is None:
        pytest.skip("a simulator of its own begins where its file says")
    for k in range(41):
        bench.beam_ref[0] = 0.03 * k / 40
        bench.run()
    bench.run(5)
    if anew == "recovered":
        bench.devices.recover()
    else:
        bench.devices.close()
        bench.devices = open_devices(Context(bench.rig, 1 / RATE_HZ, quiet_sim.parent))
    controller = Controller(bench.rig, 1 / RATE_HZ)
    core, told = bench.electronics.core, []
    drive_setpoints = core.drive_setpoints
    core.drive_setpoints = lambda plan, **begun: (told.extend(plan), drive_setpoints(plan, **begun))  # type: ignore[method-assign]
    locate(controller, bench.devices, bench.rig, bench.cycle)
    assert controller.beam_ref[0] == pytest.approx(0.03, abs=BEAM_TOLERANCE_M)
    bench.beam_ref, bench.rotor_ref = controller.beam_ref, controller.rotor_ref
    bench.run(10)
    places = [motion[0, 0] for motion in told if np.isfinite(motion[0, 0])]
    assert places
    np.testing.assert_allclose(places, 0.03, atol=BEAM_TOLERANCE_M)
    bench.devices.close()


def test_beam_and_rotor_follow_their_setpoints(bench: Bench) -> None:
    t_s, speed, turn = 1 / RATE_HZ, 0.02, 0.3
    for k in range(1, 41):
        bench.beam_ref[:] = speed * k * t_s, speed, 0.0
        bench.rotor_ref[:] = turn * k * t_s, turn, 0.0
        bench.run()
    # A setpoint written in cycle k is of the end of the period that begins with k + 1: in the
    # cycle after it was written the one before it has been reached.
    assert bench.beam[0] == pytest.approx(speed * 38 * t_s, abs=BEAM_TOLERANCE_M)
    assert bench.beam[1] == pytest.approx(speed, abs=1e-5)
    assert bench.rotor[0] == pytest.approx(turn * 38 * t_s, abs=2e-6)
    assert bench.rotor[1] == pytest.approx(turn, abs=1e-3)


def test_readings_are_finite_and_of_the_right_size(bench: Bench) -> None:
    bench.run()
    for values in (bench.gap_m, bench.readback_n, bench.beam, bench.rotor):
        assert np.isfinite(values).all()
    # At rest on the lower stops: 0.9 mm below, and some micrometres that these give.
    assert bench.gap_m == pytest.approx(-9e-4, abs=2e-5)


def test_close_leaves_zero_force_and_may_be_called_twice(bench: Bench) -> None:
    bench.coil_n[:] = 7.0
    bench.run(6)
    bench.devices.close()
    bench.devices.close()
    if bench.electronics is not None:
        core = bench.electronics.core
        # The frame with zero force goes to another thread; expiry would take 3 cycles more.
        wait_until(lambda: not core.pending_n.any())
        core.begin(core.cycle + 1)
        core.apply_setpoints()
        assert not core.acting_n.any()


def test_release_needs_no_cycle(bench: Bench) -> None:
    bench.coil_n[:] = 7.0
    bench.run(6)
    bench.devices.amplifiers.release(np.zeros(9))
    bench.coil_n[:] = 0.0
    bench.run(4)
    np.testing.assert_allclose(bench.readback_n, 0.0, atol=FORCE_TOLERANCE_N)


def test_recover_carries_on(bench: Bench) -> None:
    bench.devices.recover()
    bench.run(60)
    bench.coil_n[:] = 7.0
    bench.run(5)
    np.testing.assert_allclose(bench.readback_n, 7.0, atol=FORCE_TOLERANCE_N)


def test_no_reading_is_stale_where_every_answer_came(bench: Bench) -> None:
    before = bench.devices.stale
    bench.run(50)
    assert bench.devices.stale == before == 0


def test_a_cycle_that_begins_twice_is_answered_twice(bench: Bench, patience) -> None:
    """A flight syncs cycle 0 once to learn where the beam is, and again as its first cycle."""
    bench.coil_n[:] = 7.0
    bench.run(6)
    patience.seconds = 1.0  # an answer that does not come is not awaited for long
    before = bench.gap_m.copy()
    bench.cycle -= 1
    bench.run()
    assert bench.devices.stale == 0
    np.testing.assert_array_equal(bench.gap_m, before)  # no time has passed
