"""Emulated drives do not follow targets that their speed and acceleration do not allow for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from drives_at_rest_cycles import with_drives
from waiting import wait_until

from levid.config.rig import RigConfig
from levid.drivers.base import Context, Devices, DriveError
from levid.drivers.can.bus_link import CanLink
from levid.drivers.open_backends import open_devices
from levid.sim.electronics.emulated_rig import Electronics
from levid.wire.can.cia402 import POSITION_M, POSITION_RAD, RPDO1_ID
from levid.wire.device_protocol import DriveState

RATE_HZ = 100.0
T_S = 1.0 / RATE_HZ


pytestmark = pytest.mark.usefixtures("host_paced")


class Bench:
    """A host that leads beam and rotor anywhere, one cycle after the other."""

    def __init__(self, rig: RigConfig, devices: Devices, electronics: Electronics) -> None:
        self.rig, self.devices, self.core = rig, devices, electronics.core
        self.cycle = -1
        self.beam, self.rotor = np.zeros(3), np.zeros(3)

    def lead(
        self, beam: np.ndarray, rotor: np.ndarray, skip: int = 0, lost: tuple[int, ...] = ()
    ) -> None:
        """Exchange a cycle after so many that are skipped; targets to the nodes `lost` get lost."""
        self.cycle += 1 + skip
        gap, coil = np.zeros(9), np.zeros(9)
        for sync in self.devices.syncs:
            sync(self.cycle)
        self.devices.sensors.read(gap)
        self.devices.amplifiers.read(coil)
        self.devices.drives.read(self.beam, self.rotor)
        send = CanLink.send

        def lossy(link: CanLink, can_id: int, data: bytes) -> None:
            if can_id - RPDO1_ID not in lost:
                send(link, can_id, data)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(CanLink, "send", lossy)
            self.devices.drives.write(beam, rotor)
        wait_until(lambda: self.core.cycle == self.cycle)

    def stand(self, beam_m: float = 0.0, cycles: int = 8) -> None:
        for _ in range(cycles):
            self.lead(np.array([beam_m, 0.0, 0.0]), np.zeros(3))


@contextmanager
def benched(rig: RigConfig) -> Iterator[Bench]:
    with Electronics(rig, Path()) as electronics:
        devices = open_devices(Context(rig, T_S, Path()))
        bench = Bench(rig, devices, electronics)
        bench.stand()
        yield bench
        devices.close()


@pytest.fixture(params=[1, 4])
def bench(request, rig_on, quiet_sim: Path) -> Iterator[Bench]:
    with benched(with_drives(rig_on("can", RATE_HZ, quiet_sim), every=request.param)) as bench:
        yield bench


@pytest.fixture(params=[1, 4])
def weak_bench(request, rig_on, quiet_sim: Path) -> Iterator[Bench]:
    """As slow to speed up in a period of these, as the shipped rigs are in one of theirs."""
    rig = with_drives(rig_on("can", RATE_HZ, quiet_sim), every=request.param)
    weak = {"beam_acceleration_m_s2": 1.0}
    with benched(rig.model_copy(update={"limits": rig.limits.model_copy(update=weak)})) as bench:
        yield bench


def swing(size: float, speed: float, acceleration: float, k: int) -> np.ndarray:
    """Return position, velocity, acceleration of there and back again, as quick as it may be."""
    t = k * T_S
    up = speed / acceleration
    whole = size / speed + up
    begins = ((0.0, 1), (up, -1), (whole - up, -1), (whole, 1))
    p = v = a = 0.0
    for begin, sign in (*begins, *((whole + at, -sign) for at, sign in begins)):
        since = max(t - begin, 0.0)
        p += 0.5 * sign * acceleration * since**2
        v += sign * acceleration * since
        a += sign * acceleration * (t >= begin)
    return np.array([p, v, a])


@pytest.mark.parametrize("skip", [0, 1, 3])
def test_what_the_limits_allow_is_followed(bench: Bench, skip: int) -> None:
    """From one end of it to the other, with cycles that are skipped on the way."""
    limits, k, farthest = bench.rig.limits, 0, 0.0
    beam = 0.08, limits.beam_velocity_m_s, limits.beam_acceleration_m_s2
    rotor = 3.0, limits.rotor_velocity_rad_s, limits.rotor_acceleration_rad_s2
    while k < 100:
        skipped = skip if k % 11 == 10 else 0
        k += 1 + skipped
        bench.lead(swing(*beam, k), swing(*rotor, k), skipped)
        farthest = max(farthest, float(bench.core.axes[0, 0]))
    assert bench.core.drive_state is DriveState.OPERATING
    # With fewer SYNCs than cycles, or some that are skipped, it goes on for a period at its speed.
    assert 0.07 < farthest < 0.1


def test_host_is_told_no_speed_that_a_lost_target_did_not_make(weak_bench: Bench) -> None:
    """The beam stands still for a period and makes up for it in the next: that is twice as fast."""
    bench, speed, size = weak_bench, 0.25, 0.11
    acceleration = bench.rig.limits.beam_acceleration_m_s2
    every, told = bench.rig.on_bus("drives")[1].every, []
    for k in range(60):
        # All that a SYNC takes along of two cycles at full speed: it is once in `every`.
        lost = (1, 2) if 32 <= k < 32 + every else ()
        bench.lead(swing(size, speed, acceleration, k), np.zeros(3), lost=lost)
        told.append(bench.beam[1])
    assert bench.core.drive_state is DriveState.OPERATING
    assert 1.5 * speed < max(told) < 2.2 * speed  # it was lost, and 2, with what rounding makes


@pytest.mark.parametrize("what", ["beam", "rotor"])
@pytest.mark.parametrize("how", ["speed", "acceleration"])
def test_target_that_is_clearly_beyond_them_is_a_fault(bench: Bench, what: str, how: str) -> None:
    """The beam stays where it is, and the host has the fault DRIVE."""
    limits, every = bench.rig.limits, bench.rig.on_bus("drives")[1].every
    speed = getattr(limits, f"{what}_velocity_{'m' if what == 'beam' else 'rad'}_s")
    moved = {"speed": 3.0 * speed * every * T_S, "acceleration": 1.9 * speed * every * T_S}[how]
    if (what, how, every) == ("beam", "acceleration", 4):
        pytest.skip("in 40 ms it may turn round: what it may not do is too fast as well")
    targets = {"beam": np.zeros(3), "rotor": np.zeros(3)}
    at = targets[what]

    def fly() -> None:
        for k in range(12 * every):
            # At once, or to and fro between SYNCs within what speed alone allows.
            at[0] = moved if how == "speed" else moved * (k // every % 2)
            bench.lead(targets["beam"], targets["rotor"])

    with pytest.raises(DriveError, match="0x8611"):
        fly()
    wait_until(lambda: bench.core.drive_state is DriveState.FAULT)
    assert abs(bench.core.axes[0, 0]) < 1.1 * moved
    bench.devices.recover()
    bench.cycle += 1
    bench.stand(float(bench.core.axes[0, 0]))
    assert bench.core.drive_state is DriveState.OPERATING


def test_rounding_of_a_slow_move_is_no_acceleration(bench: Bench) -> None:
    for k in range(60):
        beam = np.array([0.4 * POSITION_M * k, 0.0, 0.0])
        bench.lead(beam, np.array([0.4 * POSITION_RAD * k, 0.0, 0.0]))
    assert bench.core.drive_state is DriveState.OPERATING


def test_encoders_that_lied_until_drives_were_switched_on_are_no_following_error(
    bench: Bench,
) -> None:
    bench.devices.drives.release()
    bench.cycle += 1
    bench.stand(cycles=4)  # quick stops alone
    wait_until(lambda: bench.core.drive_state is not DriveState.OPERATING)
    with bench.core.lock:
        bench.core.axes[:2, 0] += 0.09
    bench.devices.recover()
    bench.stand()
    assert bench.core.drive_state is DriveState.OPERATING
