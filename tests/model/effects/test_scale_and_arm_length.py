"""Test scale and arm-length effects: their terms, and that they are of the rig only."""

from __future__ import annotations

import numpy as np
import pytest
from effect_test_helpers import moving, rig_places

from levid.model.effects.base import Effect, Placed, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.combined_effects import together
from levid.model.effects.scale_and_arm_length import effects

PLACES = rig_places()


def of(key: str) -> Effect:
    return next(e for e in effects(PLACES) if e.key == key)


def test_scale_of_all_sensors_is_in_proportion_to_every_reading() -> None:
    s = moving()
    (term,) = of("sensor_scale").build(s, ())
    np.testing.assert_allclose(term.gap, np.stack([s.gap(i) for i in range(9)], axis=1))
    assert of("sensor_scale").where == tuple(f"sensor:{i}" for i in range(9))


def test_scale_of_all_coils_is_the_sum_of_the_gains_of_single_coils() -> None:
    s = moving()
    (term,) = of("coil_scale").build(s, ())
    np.testing.assert_allclose(term.held, s.coil @ PLACES.coil_shape)


@pytest.mark.parametrize(
    ("suffix", "tilts"), [("", (0, 1)), (".psi", (0,)), (".theta", (1,))], ids=str
)
def test_arms_change_tilts_and_torques_and_not_the_height(
    suffix: str, tilts: tuple[int, ...]
) -> None:
    s, kept = moving(), np.zeros(3)
    kept[list(tilts)] = 1.0
    both, damping = of(f"arm_length.both{suffix}").build(s, ())
    (sensors,) = of(f"arm_length.sensors{suffix}").build(s, ())
    (coils,) = of(f"arm_length.coils{suffix}").build(s, ())
    # The readings of a longer arm, seen as a pose by the declared one.
    assert both.gap is not None
    np.testing.assert_allclose(both.gap @ PLACES.decoupling.T, s.q * kept, atol=1e-12)
    np.testing.assert_allclose(both.held, s.coil @ PLACES.coil_shape * kept, atol=1e-12)
    np.testing.assert_allclose(damping.force, -s.qd * kept)
    np.testing.assert_array_equal(sensors.gap, both.gap)
    np.testing.assert_array_equal(coils.held, both.held)


def test_without_a_known_force_scales_are_changes_of_units() -> None:
    one, nowhere = np.eye(1), np.zeros((0, 2))
    other = Places(("q",), ("m",), one, one, "N", ("N",), "m", nowhere, nowhere, beam=False)
    assert effects(other) == []


def test_scale_of_all_sensors_acts_on_the_readings_of_other_effects_too() -> None:
    s = moving()
    scale, arm = 0.08, 0.05
    placed = (
        Placed(of("sensor_scale"), (), (scale,)),
        Placed(of("arm_length.both"), (), (arm, 0.0)),
    )
    term = together(placed, s)
    tilts = (s.q * [1.0, 1.0, 0.0]) @ PLACES.sensor_shape.T
    whole = s.q @ PLACES.sensor_shape.T
    assert term.gap is not None
    np.testing.assert_allclose(whole + term.gap, (1 + scale) * (whole + arm * tilts))
    (_, arms) = placed
    np.testing.assert_allclose(term.held, arms.term(s).held)
    np.testing.assert_array_equal(together((arms,), s).gap, arms.term(s).gap)


def test_gain_of_a_sensor_on_a_longer_arm_is_of_the_height_there() -> None:
    s, gain, arm = moving(), 0.1, 0.05
    static = {e.identity: e for e in all_effects(PLACES)}
    sensor = Placed(static["sensor_gain@sensor:2"], (), (gain,))
    longer = Placed(of("arm_length.sensors"), (), (arm,))
    there = (s.q * [1.0 + arm, 1.0 + arm, 1.0]) @ PLACES.sensor_shape.T
    read = there.copy()
    read[:, 2] *= 1.0 + gain
    term = together((sensor, longer), s)
    assert term.gap is not None
    np.testing.assert_allclose(s.q @ PLACES.sensor_shape.T + term.gap, read, atol=1e-15)


def test_gain_of_a_coil_on_a_longer_arm_has_a_larger_torque() -> None:
    s, gain, arm = moving(), -0.02, 0.05
    static = {e.identity: e for e in all_effects(PLACES)}
    coil = Placed(static["coil_gain@coil:6"], (), (gain,))
    longer = Placed(of("arm_length.coils"), (), (arm,))
    force = s.coil.copy()
    force[:, 6] *= 1.0 + gain
    there = (force @ PLACES.coil_shape) * [1.0 + arm, 1.0 + arm, 1.0]
    term = together((coil, longer), s)
    assert term.held is not None
    np.testing.assert_allclose(s.coil @ PLACES.coil_shape + term.held, there, atol=1e-12)
