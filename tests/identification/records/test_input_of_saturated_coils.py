"""Test saturated coils: the plant input is the wrench sent, not the wrench before the limits."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from in_memory_log import cycle_log

from levid.identification.nonparametric.frequency_response import (
    plant_from_joint,
    plant_from_sensitivity,
    sensitivity,
)
from levid.identification.records.from_log import FEED_FORWARD, POSE, from_log
from levid.identification.records.record import IdentificationError, PiController, Record
from levid.identification.subspace.plant_by_spectra import plant_by_spectra
from levid.log.reader import Log
from levid.log.signals import cycle_dtype

TS, X_B, ROWS = 1e-3, 0.1, 20_000
FREQ_HZ = np.geomspace(1.0, 64.0, 40)
NOTHING_LIMITED_N, LIMIT_N = 100.0, 7.9


def flown(rig: ModuleType, limit_n: float) -> tuple[list[Log], float]:
    """Return logs of white noise at each wrench, and the share of cycles with a coil at limit."""
    plant, logs, limited = rig.sampled_plant(X_B, TS), [], []
    for axis in range(3):
        v = np.zeros((ROWS, 3))
        v[:, axis] = np.random.default_rng(axis).normal(0.0, rig.EXCITATION_RMS[axis], ROWS)
        y, tau, ff, coil = rig.fly_limited(plant, v, limit_n, seed=10 + axis)
        rows = np.zeros(ROWS, cycle_dtype(9, 9))
        rows["cycle"] = np.arange(ROWS)
        rows["time_s"] = TS * np.arange(ROWS)
        rows["beam_m"], rows["coil_n"] = X_B, coil
        for names, values in (
            (("v_psi_n_m", "v_theta_n_m", "v_z_n"), v),
            (("tau_psi_n_m", "tau_theta_n_m", "tau_z_n"), tau),
            (FEED_FORWARD, ff),
            (POSE, y),
        ):
            for name, column in zip(names, values.T, strict=True):
                rows[name] = column
        logs.append(cycle_log(f"0{axis}-axis.mcap", rows))
        limited.append(np.any(np.abs(coil) == limit_n, axis=1))
    return logs, float(np.mean(limited))


def errors(rig: ModuleType, records: list[Record]) -> tuple[float, float]:
    """Return the relative error of the diagonal: rms by subspace, mean by joint spectra."""
    found = plant_by_spectra(records, lag_pole=np.exp(-TS / rig.LAG_S)).plant.response(FREQ_HZ)
    joint = plant_from_joint(records, FREQ_HZ, 4.0)
    by_subspace, by_spectra = (
        np.einsum("fii->fi", H / rig.sampled_plant(X_B, TS).frequency_response(freq_hz)) - 1
        for freq_hz, H in ((FREQ_HZ, found), (joint.freq_hz, joint.H))
    )
    return float(np.sqrt(np.mean(np.abs(by_subspace) ** 2))), float(np.abs(by_spectra.mean()))


def without(logs: list[Log], name: str) -> list[Log]:
    """Return the logs without a field."""
    kept = [n for n in logs[0].rows.dtype.names or () if n != name]
    return [cycle_log(str(log.path), log.rows[kept].copy()) for log in logs]


def test_saturated_coils_do_not_bias_the_plant(rig: ModuleType) -> None:
    logs, limited = flown(rig, LIMIT_N)
    assert 0.03 < limited < 0.07
    sent, unlimited = (
        errors(rig, list(map(from_log, ls))) for ls in (logs, without(logs, "coil_n"))
    )
    # The errors are 1.1e-4 and 0.2 % as without limits (noise, leakage). With the wrench before
    # the limits they are 2.9 and 2.6 %, the share of the wrench that the limits remove.
    assert sent[0] < 5e-4
    assert sent[1] < 0.005
    assert min(unlimited) > 0.02


def test_sensitivity_uses_the_wrench_before_the_limits(rig: ModuleType) -> None:
    logs, _ = flown(rig, LIMIT_N)
    S, without_coils = (
        sensitivity(list(map(from_log, ls)), FREQ_HZ, 4.0) for ls in (logs, without(logs, "coil_n"))
    )
    np.testing.assert_array_equal(S.H, without_coils.H)
    P = plant_from_sensitivity(S, PiController(rig.KP, rig.KI))
    true = rig.sampled_plant(X_B, TS).frequency_response(P.freq_hz)
    # The limit removes 3 % of the input. If this counted as controller output, which is small at
    # high frequencies, the mean error would be 380 %.
    assert abs(np.mean(np.einsum("fii->fi", P.H / true) - 1)) < 0.05


def test_input_is_the_same_without_saturation(rig: ModuleType) -> None:
    logs, limited = flown(rig, NOTHING_LIMITED_N)
    assert limited == 0.0
    for log, less in zip(logs, without(logs, "coil_n"), strict=True):
        sent, without_coils = from_log(log), from_log(less)
        assert sent.u is not None
        assert without_coils.u is not None
        # float32 of 9 coils of 8 N and of 69 N: some 1e-6 N, against excitations of 0.1 and more.
        np.testing.assert_allclose(sent.u, without_coils.u, atol=1e-5)
        np.testing.assert_array_equal(sent.u_unlimited, without_coils.u)


def test_log_without_coil_forces_gives_a_remark(rig: ModuleType) -> None:
    logs, _ = flown(rig, LIMIT_N)
    record = from_log(without(logs, "coil_n")[0])
    assert any("coil_n" in text for text in record.remarks)
    assert not any("coil_n" in text for text in from_log(logs[0]).remarks)


def test_number_of_coils_other_than_the_rigs_is_an_error(rig: ModuleType) -> None:
    log = flown(rig, LIMIT_N)[0][0]
    rows = np.zeros(ROWS, cycle_dtype(8, 9))
    for name in rows.dtype.names or ():
        given = log.rows[name]
        rows[name] = given[:, :8] if "coil" in name else given
    with pytest.raises(
        IdentificationError, match=r"coil_n: expected the 9 coils of rig\.yaml, found 8"
    ):
        from_log(cycle_log("00-axis.mcap", rows))
