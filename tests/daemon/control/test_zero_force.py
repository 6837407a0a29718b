"""Test what the newest log rows prove about the coil forces."""

from __future__ import annotations

import numpy as np
import pytest

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.control.preflight_findings import Outcome
from levid.daemon.control.states import State
from levid.daemon.control.zero_force import zero_force
from levid.daemon.supervision.preflight import amplifiers_finding
from levid.log.signals import Stale, cycle_dtype

RIG = load_rig(shipped("rigs/loopback.yaml"))
NOW = 1000


def rows(count: int = 10) -> np.ndarray:
    made = np.zeros(count, cycle_dtype(9, 9))
    made["cycle"] = np.arange(NOW - count + 1, NOW + 1)
    made["coil_readback_n"] = 0.003
    return made


def test_readings_near_zero_confirm_zero_force() -> None:
    found = zero_force(rows(), NOW, RIG, True)
    assert found.confirmed is True
    assert amplifiers_finding(State.IDLE, found).outcome is Outcome.PASSED


@pytest.mark.parametrize("force_n", [7.63, -7.63, np.nan])
def test_coil_that_keeps_a_force_is_named(force_n: float) -> None:
    kept = rows()
    kept["coil_readback_n"][-1, 5] = force_n
    found = zero_force(kept, NOW, RIG, True)
    assert (found.confirmed, found.found) == (False, f"coil 5 reads back {force_n:.2f} N")
    finding = amplifiers_finding(State.IDLE, found)
    assert finding.failed
    assert "coil 5" in finding.found
    assert "switch off the supply" in finding.remedy
    assert not amplifiers_finding(State.LEVITATING, found).failed


def test_old_and_repeated_readings_prove_nothing() -> None:
    repeated = rows()
    repeated["stale"] = int(Stale.AMPLIFIERS)
    for found in (
        zero_force(repeated, NOW, RIG, True),
        zero_force(rows(), NOW + 1000, RIG, True),
        zero_force(rows(0), NOW, RIG, True),
    ):
        assert found.confirmed is None
        assert amplifiers_finding(State.IDLE, found).outcome is Outcome.UNKNOWN


def test_amplifiers_that_measure_nothing_prove_nothing() -> None:
    found = zero_force(rows(), NOW, RIG, False)
    assert (found.confirmed, "do not measure" in found.found) == (None, True)
