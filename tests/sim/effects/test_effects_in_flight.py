"""Test every shipped effect in a flight: it changes the right signals and stays finite."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from effect_test_helpers import shipped_effects
from repository_folders import SIMS

from levid.config.base import load_yaml
from levid.config.sim import SimConfig
from levid.sim.effects import EffectError
from levid.sim.plant import Plant

MASSES: dict[str, Any] = {"mass_kg": 7.0, "m_b_kg": 1.4}
EVERY: dict[str, dict[str, Any]] = {
    "stiffness:CubicRods": {"dof": "psi", "k3_n_m3": 1e9},
    "stiffness:QuadraticRods": {"dof": "theta", "k2_n_m2": 1e5},
    "stiffness:BilinearRods": {"dof": "z", "k_n_m": 50},
    "air:QuadraticDamping": {"dof": "z", "d2_n_s2_m2": 100},
    "air:SqueezeFilm": {"d_n_s_m": 2, "film_m": 3e-3},
    "friction:Coulomb": {"dof": "z", "coulomb_n": 0.1, "speed_m_s": 1e-3},
    "friction:Stribeck": {
        "dof": "psi",
        "coulomb_n": 0.1,
        "static_n": 0.2,
        "stribeck_m_s": 4e-3,
        "speed_m_s": 1e-3,
    },
    "friction:Dahl": {"dof": "theta", "coulomb_n": 0.1, "stiffness_n_m": 5e3},
    "friction:LuGre": {
        "dof": "z",
        "coulomb_n": 0.1,
        "static_n": 0.15,
        "stribeck_m_s": 4e-3,
        "stiffness_n_m": 5e3,
        "damping_n_s_m": 1,
    },
    "friction:BoucWen": {"dof": "psi", "stiffness_n_m": 3e3, "yield_m": 4e-5, "left": 0.1},
    "friction:MaxwellSlip": {
        "dof": "theta",
        "stiffness_n_m": [2e3, 1e3],
        "slip_n": [0.02, 0.05],
    },
    "cable:HangingCable": {"force_n": -0.2, "x_m": 0.1, "y_m": 0.02},
    "cable:BeamCable": {"stiffness_n_m": 3, "weight_n_m": 1},
    "flexible:FlexibleMode": {"freq_hz": 80, "damping": 0.01, "mass_kg": 5},
    "masses:CentreOfMass": {"m_p_kg": 5.6, "x_m": 1e-3, "y_m": -2e-3},
    "masses:Payload": {"mass_kg": 0.05, "x_m": 0.05, "y_m": 0.03, "begin_s": 0.02},
    "bearing:BearingPresliding": {
        "axis": "x",
        "m_b_kg": 1.4,
        "stiffness_n_m": 5e5,
        "slip_n": 6,
        "damping_n_s_m": 50,
    },
    "bearing:BearingPlay": {
        "axis": "x",
        "m_b_kg": 1.4,
        "play_m": 8e-7,
        "stiffness_n_m": 5e5,
        "damping_n_s_m": 500,
    },
    "wiring:Wiring": {"coil_scale": [1, 1, 1, 1, 1.05, 1, 1, 1, 1]},
    "motors:MotorFriction": {"coulomb_n": 0.5, "speed_m_s": 2e-3, "viscous_n_s_m": 1.0},
    "motors:MotorCogging": {"amplitude_n": 0.5, "pitch_m": 0.03, "phase_rad": 0.5},
    "beam:BeamReaction": {"excess": 0.1, "m_b_kg": 1.4},
    "beam:BeamCoriolis": {"excess": 0.1, "m_b_kg": 1.4},
    "beam:BeamGravity": {"excess": 0.1, "m_b_kg": 1.4},
    "beam:MagnetField": {"amplitude_n": 0.1, "pitch_m": 0.04},
    "rotor:RotorImbalance": {"imbalance_kg_m": 1e-4, "rotor_z_m": 0.09},
    "rotor:BarTorque": {"j_kg_m2": 2e-4, "lean_x_rad": 0.02, "lean_y_rad": 0.01},
    "coils:CoilGain": {"coil": 3, "excess": 0.02},
    "coils:ForceConstant": {"coil": "all", "slope_1_m": -5.0, "curve_1_m2": -1e4},
    "coils:DeadZone": {"coil": 4, "width_n": 0.3},
    "coils:ForceOffset": {"coil": 6, "offset_n": 0.2},
    "coils:SoftSaturation": {"coil": "all", "limit_n": 30, "sharpness": 4},
    "lags:ActuatorLag": {"coil": 5, "lag_s": 4e-4},
    "lags:ExtraDelay": {"coil": "all", "delay_s": 3.5e-4},
    "lags:ThermalDrift": {"coil": 1, "loss": 0.03, "rated_n": 8, "time_constant_s": 60},
    "sensors:SensorGain": {"sensor": 2, "excess": 0.01},
    "sensors:SensorNonlinearity": {"sensor": 0, "distance_m": 0.02},
    "sensors:SensorCrosstalk": {"sensor": 1, "other": 7, "share": 0.02},
    "sensor_memory:SensorDrift": {"sensor": 5, "offset_m": 2e-6, "time_constant_s": 100},
    "sensor_memory:SensorLag": {"sensor": 6, "lag_s": 5e-4},
    "sensor_memory:StuckSensor": {"sensor": 3, "begin_s": 0.01, "stuck_s": 0.02, "free_s": 0.03},
    "sensor_memory:StickingSensor": {"sensor": 8, "step_m": 2e-6},
    "mains:MainsForce": {"dof": "z", "amplitudes_n": [0.2, 0.0, 0.1]},
    "mains:MainsPickup": {"sensor": "all", "amplitudes_m": [1e-6]},
    "ground_vibration:GroundTone": {"acceleration_m_s2": 0.1, "freq_hz": 17, **MASSES},
    "ground_vibration:GroundNoise": {"rms_m_s2": 0.05, "band_hz": [5, 40], **MASSES},
}
"""Class in levid.sim.effects -> its values."""

INSIDE = {"motors:MotorFriction", "motors:MotorCogging"}


def plant_with(folder: Path, name: str, *entries: dict[str, Any]) -> Plant:
    text = yaml.safe_load((SIMS / f"{name}.yaml").read_text())
    path = folder / "sim.yaml"
    path.write_text(yaml.safe_dump(text | {"effects": list(entries)}))
    return Plant(load_yaml(path, SimConfig), 1e-3, source=path)


def entry(use: str) -> dict[str, Any]:
    return {"use": f"levid.sim.effects.{use}", **EVERY[use]}


def fly(plant: Plant, periods: int = 100) -> tuple[np.ndarray, np.ndarray]:
    """Lift off, shake each coil, move beam and rotor; gaps (n, S) and the drives' force (n,)."""
    rng = np.random.default_rng(5)
    gaps, forces = [], []
    for i in range(periods):
        t = 1e-3 * i
        ref = np.array([0.4 * t**2, 0.8 * t, 0.8])
        turn = np.array([50 * t**2, 100 * t, 100.0])
        plant.advance(8.0 + rng.standard_normal(9), ref, turn)
        plant.sample()
        gaps.append(plant.gap_m.copy())
        forces.append(plant.beam[2])
    return np.array(gaps), np.array(forces)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plain")
    return {name: fly(plant_with(folder, name)) for name in ("nominal", "rig")}


def test_catalogue_holds_every_shipped_effect() -> None:
    assert shipped_effects() == set(EVERY)


@pytest.mark.parametrize("name", ["nominal", "rig"])
@pytest.mark.parametrize("use", EVERY)
def test_effect_flies_and_shows(tmp_path: Path, plain, use: str, name: str) -> None:
    """The plant itself checks every step that forces and motion are finite. Forces between beam
    and platform show in the drives' force, everything else in the gaps, by a converter's step of
    30.5 nm at least."""
    gaps, forces = fly(plant_with(tmp_path, name, entry(use)))
    before_gaps, before_forces = plain[name]
    assert np.isfinite(gaps).all()
    if use in INSIDE:
        assert np.abs(forces - before_forces).max() > 0.1
    else:
        assert np.abs(gaps - before_gaps).max() > 3e-8
    if use in INSIDE and name == "nominal":
        np.testing.assert_array_equal(gaps, before_gaps)


@pytest.mark.parametrize("use", EVERY)
def test_same_seed_same_flight(tmp_path: Path, use: str) -> None:
    once, again = (fly(plant_with(tmp_path, "nominal", entry(use)), 20) for _ in range(2))
    np.testing.assert_array_equal(once[0], again[0])


def test_all_at_once_fly_too(tmp_path: Path) -> None:
    gaps, _ = fly(plant_with(tmp_path, "rig", *map(entry, EVERY)), 60)
    assert np.isfinite(gaps).all()


@pytest.mark.parametrize(
    ("use", "values", "message"),
    [
        ("stiffness:CubicRods", {"dof": "x", "k3_n_m3": 1}, "dof: expected one of psi, theta, z"),
        ("coils:CoilGain", {"coil": 9, "excess": 0}, "coil: expected 0 .. 8 or all, found 9"),
        ("coils:CoilGain", {"coil": "some", "excess": 0}, "coil: expected 0 .. 8 or all"),
        ("coils:CoilGain", {"coil": True, "excess": 0}, "coil: expected 0 .. 8 or all, found True"),
        ("sensors:SensorGain", {"sensor": -1, "excess": 0}, "sensor: expected 0 .. 8 or all"),
        ("sensors:SensorCrosstalk", {"sensor": 0, "other": 12, "share": 1}, "other: expected 0"),
        ("sensors:SensorNonlinearity", {"sensor": 0, "distance_m": 1e-3}, "distance_m: expected 2"),
        ("lags:ActuatorLag", {"coil": 0, "lag_s": 0}, "lag_s: expected a number above 0"),
        ("lags:ExtraDelay", {"coil": 0, "delay_s": -1e-3}, "delay_s: expected 0 or more"),
        ("mains:MainsForce", {"dof": "z", "amplitudes_n": []}, "expected one or more"),
        (
            "ground_vibration:GroundNoise",
            {"rms_m_s2": 1, "band_hz": [9, 3], "mass_kg": 7, "m_b_kg": 1},
            "band_hz: expected",
        ),
        (
            "friction:MaxwellSlip",
            {"dof": "z", "stiffness_n_m": [1, 2], "slip_n": [1]},
            "lists of one length, found 2 and 1",
        ),
        (
            "friction:BoucWen",
            {"dof": "z", "stiffness_n_m": 1, "yield_m": 1e-5, "loss": 0.2},
            "loss: expected",
        ),
        (
            "flexible:FlexibleMode",
            {"freq_hz": 9, "damping": 0.1, "mass_kg": 1, "shape": "wave"},
            "shape: expected one of twist, saddle, bowl",
        ),
        (
            "flexible:FlexibleMode",
            {"freq_hz": 9, "damping": 0.1, "mass_kg": 1, "shape": [1, 2]},
            "shape: expected 9 numbers, found 2",
        ),
        (
            "bearing:BearingPresliding",
            {"axis": "z", "m_b_kg": 1, "stiffness_n_m": 1, "slip_n": 1, "damping_n_s_m": 1},
            "axis: expected x or y",
        ),
    ],
)
def test_values_that_make_no_sense_are_named(
    tmp_path: Path, use: str, values: dict[str, Any], message: str
) -> None:
    with pytest.raises(EffectError, match=rf"effects\[0\].*{message}"):
        plant_with(tmp_path, "nominal", {"use": f"levid.sim.effects.{use}", **values})
