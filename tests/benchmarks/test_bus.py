"""What the programs in benchmarks/bus time and count."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from levid.benchmarks.bus import (
    can_codec_speed,
    cycle_cost,
    device_fault_reaction,
    rig_on_each_backend,
    serial_transaction,
)
from levid.drivers.base import SensorError, StaleError
from levid.sim.electronics.faults import FAULTS
from levid.wire.bus_budget import check_budget


@pytest.mark.parametrize("name", ["can", "canfd", "canfd_udp", "serial"])
def test_wire_carries_the_timed_rigs(name: str, tmp_path: Path) -> None:
    rig = rig_on_each_backend.rig_on(name, tmp_path)
    assert check_budget(rig, tmp_path).cycle_s * rig.rate_hz <= 1.0


def test_codec_that_rejects_a_frame_is_not_timed(monkeypatch) -> None:
    monkeypatch.setattr(can_codec_speed, "BATCHES", 2)
    can_codec_speed.codec_figures(10)
    monkeypatch.setattr("levid.wire.can.can_frames.ValueFrames.finish", lambda *_: "no")
    with pytest.raises(AssertionError):
        can_codec_speed.codec_figures(10)


def test_stale_cycles_are_counted_and_not_timed() -> None:
    found = cycle_cost.run_cycles(lambda k: k % 4 > 0, 20)
    assert found.stale > 0
    assert len(found.times_s) == round(20 * (1.0 - found.stale))


def test_serial_transaction_with_a_wrong_reading_ends_the_run() -> None:
    with serial_transaction.device() as path:
        driver = serial_transaction.Driver(path)
        try:
            driver()
            driver.readings.require()
            driver.readings.gap_m[3] += serial_transaction.GAP_M
            with pytest.raises(AssertionError):
                driver.readings.require()
        finally:
            driver.port.close()


def test_fault_is_named_by_the_class_and_the_words_of_its_error() -> None:
    names = device_fault_reaction.names
    assert names(SensorError("sensors on x: sensor 4: no reading"), "stuck 4")
    assert not names(SensorError("sensors on x: sensor 5: no reading"), "stuck 4")
    assert not names(StaleError("sensors on x: sensor 4: no reading"), "stuck 4")
    assert not names(None, "stuck 4")


def test_every_fault_of_a_device_is_injected() -> None:
    faults = {line.split()[0] for line in device_fault_reaction.EXPECTED}
    assert faults == set(FAULTS) - device_fault_reaction.NOT_REPORTED


def test_force_that_comes_back_is_counted(monkeypatch) -> None:
    """A device whose force never ends takes all cycles; one whose force returns is counted."""
    acting = iter([1, 1, 0, 0, 1, *[0] * device_fault_reaction.AFTER_CYCLES])
    raised = StaleError("amplifiers on x: no clean reading")

    class Amplifiers(SimpleNamespace):
        injected = False

        def write(self, _: object) -> None:
            if self.injected:
                raise raised

    amplifiers = Amplifiers(read=lambda _: None, release=lambda _: None)
    nothing = SimpleNamespace(read=lambda *_: None, write=lambda *_: None)
    devices = SimpleNamespace(
        syncs=[], sensors=nothing, drives=nothing, amplifiers=amplifiers, backends=[]
    )

    class Core:
        @property
        def acting_n(self) -> np.ndarray:
            return np.array([next(acting)])

        def pass_period(self) -> None: ...

    injector = SimpleNamespace(
        command=lambda _: setattr(amplifiers, "injected", True), receives=False
    )
    electronics = SimpleNamespace(core=Core(), injector=injector)
    monkeypatch.setattr(device_fault_reaction, "_PACE_S", 0.0)
    assert device_fault_reaction._play(devices, electronics, "drop") == (2, 1, raised)
