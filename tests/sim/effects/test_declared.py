"""Test effects of a model file on the simulated plant against their terms along a whole motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from effect_test_helpers import DT_S, fresh, rig_places

from levid.config.model import EffectParameter, ModelEffect, load_model
from levid.config.shipped import shipped
from levid.identification.greybox.identify_greybox import to_yaml
from levid.model.effects.base import Signals
from levid.model.effects.effect_serialization import placed_effects
from levid.sim.effects.declared import FromModel
from levid.sim.effects.effect_interface import BeamState


def effect(key: str, where: str, **values: tuple[float, str]) -> ModelEffect:
    parameters = {name: EffectParameter(value=v, unit=u) for name, (v, u) in values.items()}
    return ModelEffect(effect=key, where=(where,), parameters=parameters)


def played(folder: Path, *effects: ModelEffect) -> FromModel:
    model = load_model(shipped("models/rig.yaml")).model_copy(update={"effects": effects})
    (folder / "model.yaml").write_text(to_yaml(model))
    return fresh(FromModel(model=str(folder / "model.yaml")))  # type: ignore[no-any-return]


def at_rest(x_m: float = 0.0, v_m_s: float = 0.0) -> BeamState:
    return BeamState(x_m, v_m_s, 0.0, 0.0, 0.0, 0.0)


def test_a_spring_pushes_half_a_step_ahead(tmp_path: Path) -> None:
    cubic = played(tmp_path, effect("rod_stiffness.cubic", "z", k3=(2e8, "N/m^3")))
    q, qd = np.array([0.0, 0.0, 3e-4]), np.array([0.0, 0.0, 0.02])
    force = cubic.wrench(0.1, q, qd, at_rest())
    # Held over the step, a spring that acts half a step late would feed the motion.
    z = q[2] + 0.5 * DT_S * qd[2]
    np.testing.assert_allclose(force, [0.0, 0.0, -2e8 * z**3], rtol=1e-12)
    # It has no other contribution.
    np.testing.assert_array_equal(cubic.coil_force(0.1, q, np.arange(9.0)), np.arange(9.0))
    np.testing.assert_array_equal(cubic.gap(0.1, np.arange(9.0)), np.arange(9.0))
    assert cubic.beam_force(0.1, at_rest(), q, qd) == 0.0


def test_weak_coil_gives_the_wrench_of_the_effect(tmp_path: Path) -> None:
    weak = played(tmp_path, effect("coil_gain", "coil:6", gain=(-0.1, "1")))
    asked = np.linspace(5.0, 9.0, 9)
    given = weak.coil_force(0.0, np.zeros(3), asked)
    lacking = np.zeros(9)
    lacking[6] = -0.1 * asked[6]
    # A rigid platform only depends on the wrench, not on the coils that produce it.
    S = rig_places().coil_shape
    np.testing.assert_allclose(S.T @ (given - asked), S.T @ lacking, atol=1e-12)


def test_sensor_effect_changes_only_its_reading(tmp_path: Path) -> None:
    false = played(tmp_path, effect("sensor_gain", "sensor:2", gain=(0.05, "1")))
    gap = rig_places().sensor_shape @ np.array([1e-3, -2e-3, 1e-4])
    expected = gap.copy()
    expected[2] *= 1.05
    np.testing.assert_allclose(false.gap(0.0, gap), expected, rtol=1e-12)


def test_drives_compensate_friction_on_the_beam(tmp_path: Path) -> None:
    friction = effect("friction.beam", "beam", friction=(0.3, "N"), v_s=(1e-3, "m/s"))
    sliding = played(tmp_path, friction)
    beam = at_rest(0.0, 0.1)
    sliding.wrench(0.0, np.zeros(3), np.zeros(3), beam)
    # tanh(100) is 1 to the last digit.
    assert sliding.beam_force(0.0, beam, np.zeros(3), np.zeros(3)) == pytest.approx(-0.3)


def test_effect_with_memory_follows_the_whole_motion(tmp_path: Path) -> None:
    declared = effect("friction.dahl", "z", friction=(0.2, "N"), x_s=(2e-5, "m"))
    dahl = played(tmp_path, declared)
    t = DT_S * np.arange(20_000)
    z = 2e-4 * np.sin(2 * np.pi * 3 * t) + 5e-5 * np.sin(2 * np.pi * 11 * t)
    rate = np.gradient(z, DT_S)
    force = np.array(
        [
            dahl.wrench(at, np.array([0, 0, a]), np.array([0, 0, v]), at_rest())[2]
            for at, a, v in zip(t, z, rate, strict=True)
        ]
    )
    every = 10
    rows = len(t[::every])
    nothing, none = np.zeros((rows, 3)), np.zeros(rows)
    q, qd = nothing.copy(), nothing.copy()
    q[:, 2], qd[:, 2] = z[::every], rate[::every]
    along = Signals(
        every * DT_S, t[::every], q, qd, nothing, np.zeros((rows, 9)), none, none, none,
        none, none, none, 0, rig_places(),
    )  # fmt: skip
    (placed,) = placed_effects([declared], rig_places())
    whole = placed.term(along).force
    assert whole is not None
    # Held for a millisecond: off by what the motion adds to the force in one, 0.2 N / 20 um times
    # 7 mm/s times 1 ms at most, while it has only just turned. The first half second is left out,
    # since what was before a motion's begin each guesses from what it knows of it.
    error = force[::every][500:] - whole[500:, 2]
    assert np.abs(error).max() < 0.2 / 2e-5 * 7e-3 * 1e-3
    assert np.sqrt(np.mean(error**2)) < 0.02


def test_spring_held_for_a_millisecond_does_no_work(tmp_path: Path) -> None:
    """Friction far below its slip is a spring; late by half of what it is held, it would drive."""
    dahl = played(tmp_path, effect("friction.dahl", "z", friction=(0.2, "N"), x_s=(2e-3, "m")))
    t = DT_S * np.arange(20_000)
    omega, size = 2 * np.pi * 10.0, 1e-6
    z, rate = size * np.sin(omega * t), size * omega * np.cos(omega * t)
    force = np.array(
        [
            dahl.wrench(at, np.array([0, 0, a]), np.array([0, 0, v]), at_rest())[2]
            for at, a, v in zip(t, z, rate, strict=True)
        ]
    )
    # Of whole periods at the end. In the middle of the step a force acts at q + v dt / 2.
    work = DT_S * np.sum((force * (rate - 0.5 * DT_S * omega**2 * z))[-10_000:])
    k, periods = 0.2 / 2e-3, DT_S * 10_000 * 10.0
    late_by_half = periods * np.pi * k * size**2 * omega * 0.5e-3
    assert work < 0.05 * late_by_half


def test_model_without_effects_changes_nothing(tmp_path: Path) -> None:
    nothing = played(tmp_path)
    q, qd, forces = np.full(3, 1e-4), np.full(3, 1e-2), np.linspace(-1.0, 1.0, 9)
    assert np.all(nothing.coil_force(0.0, q, forces) == forces)
    assert np.all(nothing.wrench(DT_S, q, qd, at_rest()) == 0.0)
