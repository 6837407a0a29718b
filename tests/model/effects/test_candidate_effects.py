"""Test the candidate effects: equations along known trajectories, and the whole table."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from effect_test_helpers import CLASSES, R_M, rig_places

from levid.model.effects import beam_friction_and_cogging, flexible, vibration
from levid.model.effects.base import Effect, Loads, Placed, Places, Signals
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.lag_and_hysteresis_recursions import lagged_mean, with_moment
from levid.model.effects.operating_range import Extent

TS = 1e-3
OTHERS = {"stiffness", "damping", "inertia"}
WHERE = re.compile(r"psi|theta|z|beam|rotor|coil:[0-8]|sensor:[0-8]")


def one_dof() -> Places:
    one, nowhere = np.eye(1), np.zeros((0, 2))
    return Places(("q",), ("m",), one, one, "N", ("N",), "m", nowhere, nowhere, beam=False)


@cache
def moving(places_of=rig_places, rows: int = 6000) -> Signals:
    """Return periodic tilting and lifting over 6 s, with exact derivatives."""
    places = places_of()
    n, t = len(places.dof), np.arange(rows) * TS + 20.0
    rng = np.random.default_rng(3)

    def tones(count: int, low: int, high: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        w = 2 * np.pi * rng.integers(low, high, (4, count)) / 6.0
        phase = rng.uniform(0, 2 * np.pi, (4, count))
        angle = w * t[:, None, None] + phase
        return tuple(
            f.sum(axis=1) for f in (np.sin(angle), w * np.cos(angle), -w * w * np.sin(angle))
        )

    size = (2e-4 / np.abs(places.sensor_shape).max(axis=0))[:n]
    q, qd, qdd = (size * part for part in tones(n, 3, 40))
    (x_b, v_b, a_b), (phi, phid, phidd) = (
        tuple(scale * part[:, 0] for part in tones(1, 1, 4)) for scale in (0.03, 5.0)
    )
    coil = 7.6 + 2.0 * rng.standard_normal((rows, places.coils))
    return Signals(
        TS, t, q, qd, qdd, coil, x_b, v_b, a_b, phi, phid, phidd, delay_cycles=1, places=places
    )  # fmt: skip


@cache
def table(places_of=rig_places) -> dict[str, Effect]:
    places = places_of()
    return {e.identity: e for e in all_effects(places, Extent.measured([moving(places_of)]))}


def term(identity: str, shape=None, signals: Signals | None = None, places_of=rig_places):
    """Return the first term of an effect, at the first row of its grid or at `shape`."""
    effect = table(places_of)[identity]
    return effect.build(
        moving(places_of) if signals is None else signals,
        effect.grid[0] if shape is None else shape,
    )[0]


def power(force: np.ndarray, s: Signals) -> np.ndarray:
    return np.einsum("ni,ni->n", force, s.qd)


BOTH = pytest.mark.parametrize("places_of", [rig_places, one_dof])


# The table.


@BOTH
def test_every_effect_gives_a_term_for_each_amplitude_of_the_right_shape(places_of):
    s = moving(places_of)
    widths = (s.places.coil_shape.shape[1], len(s.places.dof), s.places.sensors)
    for effect in table(places_of).values():
        for row in effect.grid:
            terms = effect.build(s, row)
            assert len(terms) == len(effect.amplitudes), effect.identity
            for found in terms:
                assert any(part is not None for part in found.parts), effect.identity
                for part, width in zip(found.parts, (*widths, None), strict=True):
                    if part is not None:
                        assert part.shape == ((s.rows,) if width is None else (s.rows, width))
                        assert np.all(np.isfinite(part)), effect.identity


@BOTH
def test_identities_of_effects_are_unique(places_of):
    effects = all_effects(places_of())
    assert len({e.identity for e in effects}) == len(effects)


def test_table_of_the_rig_has_every_class_with_valid_locations():
    effects = table().values()
    assert {e.effect_class for e in effects} == CLASSES
    for effect in effects:
        assert all(WHERE.fullmatch(w) for w in effect.where), effect.identity


def test_table_of_another_plant_has_no_beam_effects():
    classes = {e.effect_class for e in table(one_dof).values()}
    assert OTHERS | {"friction"} <= classes
    assert not classes & {"beam_motion", "rotor", "external_field", "payload"}


@BOTH
def test_pickled_effects_give_the_same_terms(places_of):
    s = moving(places_of)
    for effect in table(places_of).values():
        there = pickle.loads(pickle.dumps(effect))
        for a, b in zip(
            effect.build(s, effect.grid[0]), there.build(s, effect.grid[0]), strict=True
        ):
            for one, other in zip(a.parts, b.parts, strict=True):
                assert (one is None) == (other is None)
                assert one is None or np.array_equal(one, other)


def test_number_of_screened_columns_is_limited():
    # Effects on the drives alone are no columns of the platform's filter. A tone has 3 forces, the
    # floor, 9 readings and a common reading, each with a cosine and a sine: 28. Stuck sensors count
    # only if readings are stuck. 30 of these columns are friction that depends on the direction.
    s, count = moving(), 0
    usual = replace(Extent.typical(s.places), tones_hz=(), stuck=())
    for effect in all_effects(s.places, usual):
        for row in effect.grid:
            count += sum(any(p is not None for p in t.parts[:3]) for t in effect.build(s, row))
    assert count <= 520
    assert sum(len(e.amplitudes) for e in vibration.tone(s.places, 50.0)) == 28


@BOTH
def test_quantities_have_units_and_shapes_lie_within_bounds(places_of):
    for effect in table(places_of).values():
        assert all(q.unit for q in (*effect.amplitudes, *effect.shape)), effect.identity
        for row in effect.grid:
            assert len(row) == len(effect.shape)
            for value, q in zip(row, effect.shape, strict=True):
                # The search takes logarithmic steps, or steps relative to a finite range.
                assert np.isfinite([q.low, q.high]).all(), (effect.identity, q.name)
                assert q.low <= value <= q.high, (effect.identity, q.name)
                assert not q.log or q.low > 0


_JUMP = ("sensor_stuck.jump", "actuator.quantised", "backlash.bearing", "backlash.load")


@BOTH
def test_terms_are_smooth_in_their_shape(places_of):
    s = moving(places_of)
    for effect in table(places_of).values():
        if effect.key in _JUMP:
            continue  # They jump at other times with another width, so they have no derivative.
        row = effect.grid[0]
        for i, q in enumerate(effect.shape):
            step = 1e-3 * row[i] if q.log else 1e-6 * (q.high - q.low)
            slopes = [_slope(effect, s, row, i, h) for h in (step, step / 2)]
            # Clipping moves a few rows from one branch to the other, which is less than a tenth
            # of the slope's square; otherwise the slopes differ by the square of the step.
            apart = np.linalg.norm(slopes[0] - slopes[1])
            assert apart <= 0.3 * np.linalg.norm(slopes[1]), (effect.identity, q.name)


def _slope(effect: Effect, s: Signals, row, i: int, step: float) -> np.ndarray:
    ends = []
    for sign in (1, -1):
        there = list(row)
        there[i] += sign * step
        terms = effect.build(s, there)
        ends.append(np.concatenate([p.ravel() for t in terms for p in t.parts if p is not None]))
    return (ends[0] - ends[1]) / (2 * step)


def test_extent_is_the_range_of_the_records():
    s = moving()
    slow = replace(s, q=0.5 * s.q, qd=0.5 * s.qd, time_s=s.time_s + 100)
    extent = Extent.measured([slow, s])
    np.testing.assert_allclose(extent.reach, s.q.std(axis=0))
    np.testing.assert_allclose(extent.speed, s.qd.std(axis=0))
    assert extent.spans_s == ((120.0, slow.time_s[-1]), (20.0, s.time_s[-1]))
    assert extent.beam_m == np.ptp(s.x_b_m)


# Energy of forces along a closed path of the platform.


def test_stiffness_conserves_energy():
    s = moving()
    for identity, effect in table().items():
        if effect.effect_class == "rod_stiffness":
            p = power(term(identity).force, s)
            # The sum over whole periods of a periodic motion is its integral, up to rounding. Kinks
            # between two samples give an error of the square of their distance.
            within = 1e-3 if "one_sided" in identity else 1e-9
            assert abs(p.sum()) < within * np.abs(p).sum(), identity


@BOTH
def test_damping_and_friction_dissipate_energy(places_of):
    s = moving(places_of)
    for effect in table(places_of).values():
        if effect.where and effect.where[0] in s.places.dof and effect.key in {
            "air_damping.linear", "air_damping.quadratic", "air_damping.drag", "damping.quadratic",
            "damping.outward", "friction.coulomb", "friction.stribeck", "friction.dahl",
            "friction.maxwell_slip", "friction.bouc_wen", "friction.lugre", "backlash.play",
        }:  # fmt: skip
            for found in effect.build(s, effect.grid[0]):
                assert power(found.force, s).sum() < 0, effect.identity


@BOTH
def test_bounds_of_dissipative_effects_keep_them_passive(places_of):
    # These may be negative: changes of a fitted damping, and the beam's cable chain.
    # An asymmetry moves friction from one direction to the other, a and b from place to place, and
    # a cold bearing may rub less.
    free = ("air_damping.linear", "damping.outward", "damping.one_sided", "friction.beam_chain")
    free += ("air_damping.across", "damping.across", "damping.drift", "damping.warming")
    for effect in table(places_of).values():
        dissipates = effect.effect_class in ("friction", "air_damping", "damping")
        if (dissipates and effect.key not in free) or effect.key == "flexible_mode.loose_mass":
            signed = (
                ("a", "b") if effect.key == "friction.along_position" else ("asymmetry", "excess")
            )
            for quantity in effect.amplitudes:
                expected = -np.inf if quantity.name in signed else 0.0
                assert quantity.low == expected, (effect.identity, quantity.name)


def test_squeeze_film_damping_is_larger_below_and_smaller_above():
    s = moving()
    force = term("air_damping.squeeze_film_lift@z").force[:, 2]
    z, zd = s.q[:, 2], s.qd[:, 2]
    assert np.all(force * zd * np.sign(z) >= 0)
    h0 = table()["air_damping.squeeze_film_lift@z"].grid[0][0]
    np.testing.assert_allclose(force, -((1 + z / h0) ** -3 - 1) * zd, rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize(("name", "m"), [("linear", lambda q: q), ("quadratic", lambda q: q**2)])
def test_power_of_variable_inertia_equals_the_rate_of_its_kinetic_energy(name, m):
    s = moving(one_dof)
    q, qd = s.q[:, 0], s.qd[:, 0]
    p = power(term(f"inertia.{name}@q", places_of=one_dof).force, s)
    _same_as_rate(-p, 0.5 * m(q) * qd**2)


@pytest.mark.parametrize(("axis", "tilt"), [("psi", 0), ("theta", 1)])
def test_power_of_an_offset_centre_of_mass_equals_the_rate_of_its_energy(axis, tilt):
    s = moving()
    p = power(term(f"centre_of_mass@{axis}+z").force, s)
    _same_as_rate(-p, s.qd[:, tilt] * s.qd[:, 2])


def test_power_of_a_payload_equals_the_rate_of_its_energy():
    s, x, y = moving(), 0.05, -0.08
    found = term("payload@psi+theta+z", (s.time_s[0] - 1.0, 0.01, x, y))
    height, rise = (f @ [y, x, 1.0] for f in (s.q, s.qd))
    _same_as_rate(-power(found.force, s), 0.5 * rise**2 + 9.81 * height)


def test_payload_has_no_force_before_its_time():
    s = moving()
    force = term("payload@psi+theta+z", (s.time_s[3000], 0.1, 0.0, 0.0)).force
    # Ten rise times before and after, tanh is exactly -1 and 1.
    assert not np.any(force[:1900])
    np.testing.assert_allclose(force[4100:, 2], -(9.81 + s.qdd[4100:, 2]))


def _same_as_rate(power_w: np.ndarray, energy_j: np.ndarray) -> None:
    # Fourth-order differences have errors of (w Ts)^4 / 30 = 1e-4 at 40 Hz, the highest frequency.
    rate = (8 * (energy_j[3:-1] - energy_j[1:-3]) - energy_j[4:] + energy_j[:-4]) / (12 * TS)
    np.testing.assert_allclose(power_w[2:-2], rate, atol=1e-3 * np.abs(rate).max())


# Coils.


def coil_signals(F: np.ndarray) -> Signals:
    s = moving()
    coil = np.full((s.rows, 9), 7.6)
    coil[:, 2] = F
    return replace(s, coil=coil)


def test_coil_gain_adds_a_wrench_at_the_coils_position():
    s = moving()
    held = term("coil_gain@coil:2").held
    np.testing.assert_allclose(held, np.outer(s.coil[:, 2], [-R_M, R_M, 1.0]))


def test_force_constant_uses_the_height_while_the_command_acts():
    s = moving()
    held = term("force_constant.linear@coil:2").held[:, 2]
    h = s.q @ [-R_M, R_M, 1.0]
    k = 100
    # delay_cycles = 1: the command of row 100 acts from row 101 to row 102.
    # What the height does within the period makes up the rest.
    assert held[k] == pytest.approx(s.coil[k, 2] * (h[k + 1] + h[k + 2]) / 2, rel=3e-3)
    assert held[k] != pytest.approx(s.coil[k, 2] * (h[k] + h[k + 1]) / 2, rel=3e-3)
    # The lag acts on command and height alike, so the height is taken ahead by the lag.
    effect = table()["force_constant.linear@coil:2"]
    (late,) = effect.build(replace(s, lag_s=3e-4), ())
    ahead = h + 3e-4 * (s.qd @ [-R_M, R_M, 1.0])
    expected = s.coil[k, 2] * (ahead[k + 1] + ahead[k + 2]) / 2
    assert late.held[k, 2] == pytest.approx(expected, rel=3e-3)


def test_effect_of_all_coils_is_the_sum_of_single_coils():
    for key in ("force_constant.linear", "force_constant.quadratic", "thermal_drift.time",
                "thermal_drift.heat"):  # fmt: skip
        alone = sum(term(f"{key}@coil:{c}").held for c in range(9))
        together = term(f"{key}@{'+'.join(f'coil:{c}' for c in range(9))}").held
        np.testing.assert_allclose(together, alone, atol=1e-9 * np.abs(alone).max())


def test_dead_zone_is_zero_inside_and_reduced_by_its_width_outside():
    s = moving()
    F = np.linspace(-10, 10, s.rows)
    given = F + term("dead_zone@coil:2", (3.0,), coil_signals(F)).held[:, 2]
    np.testing.assert_allclose(given, np.sign(F) * np.maximum(np.abs(F) - 3, 0), atol=1e-12)


@pytest.mark.parametrize(
    ("key", "shape", "most"),
    # Four points per period are accurate to 1e-4 for a smooth curve and to 1e-2 for one with a
    # corner. With the command in place of the force, the errors are 0.03 and 0.09.
    [("saturation@coil:2", (10.0, 4.0), 1e-3), ("dead_zone@coil:2", (3.0,), 1e-2)],
)
def test_saturation_and_dead_zone_act_on_the_lagged_force(key: str, shape, most: float):
    command_noise = np.random.default_rng(1).normal(7.6, 16, (moving().rows, 4)).mean(axis=1)
    s = replace(coil_signals(np.convolve(command_noise, [0.25, 0.5, 0.25], "same")), lag_s=3e-4)
    found = -lagged_mean(term(key, shape, s).held[:, 2], s.lag_s, TS)
    fine, expected, force = np.arange(0.5, 200) / 200 * TS, [], s.coil[0, 2]
    for command in s.coil[:300, 2]:
        within = command + (force - command) * np.exp(-fine / s.lag_s)
        held = coil_signals(np.resize(within, s.rows))
        expected.append(-term(key, shape, held).held[: len(fine), 2].mean())
        force = command + (force - command) * np.exp(-TS / s.lag_s)
    assert np.std(found[:300] - expected) < most * np.std(expected)


def test_saturation_ranges_from_soft_to_hard():
    s = moving()
    F = np.linspace(-30, 30, s.rows)
    soft, hard = (
        F + term("saturation@coil:2", (10.0, p), coil_signals(F)).held[:, 2] for p in (2.0, 40.0)
    )
    np.testing.assert_allclose(soft, F / np.sqrt(1 + (F / 10) ** 2), atol=1e-12)
    # At the limit it is 2^(-1/40) of it: 1.7 % less than a clip, the largest difference.
    np.testing.assert_allclose(hard, np.clip(F, -10, 10), atol=0.18)


def test_unit_amplitude_saturation_loses_the_same_force_far_below_its_limit():
    s = coil_signals(np.linspace(-6, 6, moving().rows))
    effect = table(rig_places)["saturation@coil:2"]
    assert effect.shape_of_unit_amplitude is not None
    shape = effect.shape_of_unit_amplitude((0.3,), (25.0, 4.0))
    part = 0.3 * term("saturation@coil:2", (25.0, 4.0), s).held[:, 2]
    np.testing.assert_allclose(
        term("saturation@coil:2", shape, s).held[:, 2], part, atol=2e-3 * np.ptp(part)
    )


def test_short_lag_equals_a_delay_and_long_lag_is_exact():
    s = moving()
    t = s.time_s
    F = 7.6 + np.sin(2 * np.pi * 5 * t)
    signals = coil_signals(F)
    delay = term("delay@coil:2", (2e-4,), signals)
    short = term("actuator_lag@coil:2", (2e-4,), signals)
    # At 5 Hz a lag of 0.2 ms differs from a delay by w tau = 0.6 %.
    np.testing.assert_allclose(short.held[5:, 2], delay.held[5:, 2], atol=0.01 * 2 * np.pi * 5)
    tau = 0.02
    late = F + tau * term("actuator_lag@coil:2", (tau,), signals).held[:, 2]
    w = 2 * np.pi * 5
    # The half period of the zero-order hold cancels with the mean over the next period.
    expected = 7.6 + np.imag(np.exp(1j * w * t) / (1 + 1j * w * tau))
    np.testing.assert_allclose(late[500:], expected[500:], atol=2e-3)


def test_delay_effect_has_the_mean_and_moment_of_the_delayed_command():
    s = moving()
    F = np.cumsum(np.random.default_rng(5).normal(size=s.rows))  # steps, held for a period each
    for back_s in (4e-4, 1e-3, 3.4e-3):
        late = F + back_s * term("delay@coil:2", (back_s,), coil_signals(F)).held[:, 2]
        # 100 instants of each period, shifted by the delay; their means have no error.
        fine = np.repeat(F, 100)
        back = round(back_s / TS * 100)
        shifted = np.concatenate([np.full(back, F[0]), fine])[: len(fine)]
        periods = shifted.reshape(-1, 100)
        moment = periods @ ((np.arange(100) + 0.5) / 100 - 0.5) / 100
        expected = with_moment(periods.mean(axis=1), moment)
        np.testing.assert_allclose(late, expected, atol=1e-9)


def test_negative_delay_is_bounded_by_the_declared_delay_and_lag():
    s = replace(moving(), delay_cycles=2, lag_s=3e-4)
    found = {e.identity: e for e in all_effects(s.places, Extent.measured([s]))}
    for name in ("delay@coil:4", "actuator_lag@coil:4"):
        assert found[name].amplitudes[0].low == pytest.approx(-2.3e-3)


def test_heat_rises_with_the_square_of_the_force_since_the_session_began():
    s = coil_signals(np.full(moving().rows, 6.0))
    tau, before = 30.0, 2.0
    held = term("thermal_drift.heat@coil:2", (tau, before), s).held[:, 2]
    np.testing.assert_allclose(held, -6.0 * 36.0 * (1 - np.exp(-(s.time_s + before) / tau)))


def test_heat_at_the_start_of_a_record_follows_from_the_session():
    # 8 N from 2 s before 0 s, 3 N from 6 s, nothing known from 10 s on; the record begins at 20 s.
    loads = Loads((0.0, 6.0, 10.0), tuple((0.0, 0.0, f * f, *[0.0] * 6) for f in (8.0, 3.0, 3.0)))
    s = coil_signals(np.zeros(moving().rows))
    s = replace(s, coil=s.coil + np.eye(9)[2], places=replace(s.places, loads=loads))
    tau, before = 30.0, 2.0
    began = 64 * (1 - np.exp(-8 / tau)) * np.exp(-14 / tau) + 9 * (1 - np.exp(-14 / tau))
    held = term("thermal_drift.heat@coil:2", (tau, before), s).held[:, 2]
    t = s.time_s - 20.0
    np.testing.assert_allclose(held, -(1 + (began - 1) * np.exp(-t / tau)), rtol=1e-9)


# Sensors and the flexible platform.


def test_sensor_lag_is_a_first_order_lag():
    t = moving().time_s
    w, tau = 2 * np.pi * 3.0, 0.01
    q = np.zeros((len(t), 3))
    q[:, 2] = 1e-4 * np.sin(w * t)
    late = q[:, 2] + tau * term("sensor_lag@sensor:4", (tau,), replace(moving(), q=q)).gap[:, 4]
    expected = 1e-4 * np.imag(np.exp(1j * w * t) / (1 + 1j * w * tau))
    # Linear interpolation between samples has an error of (w Ts)^2 / 12.
    np.testing.assert_allclose(late[500:], expected[500:], atol=1e-4 * 1e-4)


def test_table_has_crosstalk_of_every_sensor_pair():
    pairs = [e.where for e in all_effects(rig_places()) if e.key == "sensor_crosstalk"]
    assert len(set(pairs)) == 9 * 8
    found = term("sensor_crosstalk@sensor:0+sensor:1").gap
    np.testing.assert_allclose(found[:, 0], moving().gap(1))
    assert not np.any(found[:, 1:])


def test_patterns_are_orthogonal_to_rigid_motion_and_to_each_other():
    places = rig_places()
    names, over_sensors, over_coils = flexible.patterns(places)
    assert len(names) == 9
    np.testing.assert_allclose(over_sensors.T @ over_sensors, np.eye(9), atol=1e-12)
    np.testing.assert_allclose(places.sensor_shape.T @ over_sensors[:, 3:], 0, atol=1e-12)
    np.testing.assert_allclose(
        over_coils, over_sensors, atol=1e-12
    )  # coils and sensors are collocated


def test_mode_has_no_coupling_to_wrench_and_pose():
    s, mode = moving(), table()["flexible_mode.twist@"]
    T = s.places.decoupling
    (bent,) = mode.build(s, mode.grid[0])
    assert np.abs(bent.gap).max() > 0
    np.testing.assert_allclose(bent.gap @ T.T, 0, atol=1e-12 * np.abs(bent.gap).max())
    wrench = np.random.default_rng(0).standard_normal((s.rows, 3))
    (still,) = mode.build(replace(s, coil=wrench @ T), mode.grid[0])
    assert np.abs(still.gap).max() < 1e-9 * np.abs(bent.gap).max()


def test_mode_far_below_its_frequency_is_a_compliance():
    s, mode = moving(), table()["flexible_mode.saddle@"]
    F = 7.6 + np.outer(np.sin(2 * np.pi * 1.0 * s.time_s), np.eye(9)[0])
    f = 300.0
    (bent,) = mode.build(replace(s, coil=F), (f, 0.05, *mode.grid[0][2:]))
    _, phi, _ = flexible.patterns(s.places)
    saddle = phi[:, 4]
    acting = np.roll(F - 7.6, 1, axis=0) @ saddle  # delay_cycles = 1
    expected = np.outer(acting, saddle) / (2 * np.pi * f) ** 2
    # A row has the command of the previous period: a delay of w Ts = 0.6 % at 1 Hz.
    np.testing.assert_allclose(bent.gap[100:], expected[100:], atol=0.01 * np.abs(expected).max())


def test_loose_mass_acts_below_its_frequency_and_decouples_above():
    t = moving().time_s
    for f, wanted, within in ((2.0, 1.0, 0.02), (60.0, 0.0, 0.2)):
        w = 2 * np.pi * f
        q, qd = np.zeros((len(t), 3)), np.zeros((len(t), 3))
        q[:, 2], qd[:, 2] = np.sin(w * t), w * np.cos(w * t)
        (found,) = table()["flexible_mode.loose_mass@z"].build(
            replace(moving(), q=q, qd=qd), (20.0, 0.3)
        )
        force = found.force[3000:, 2]  # after it has settled
        share = 2 * np.mean(force * np.sin(w * t[3000:])) / (w * w)
        # (f / 20 Hz)^2 = 1 % more than the full mass at 2 Hz; (20 Hz / f)^2 = 11 % of it at 60 Hz.
        assert share == pytest.approx(wanted, abs=within)


# Beam, rotor, tones.


def test_rotor_imbalance_force_is_opposite_to_its_acceleration():
    s = moving()
    pushed = [t.force[:, 2] for t in table()["rotor.imbalance@rotor+z"].build(s, ())]
    for found, place in zip(pushed, (np.cos(s.phi_rad), np.sin(s.phi_rad)), strict=True):
        second = np.gradient(np.gradient(place, TS), TS)
        inner = slice(5, -5)
        # Second differences at up to 40 rad/s have errors of (w Ts)^2 / 6, and more for products.
        np.testing.assert_allclose(
            found[inner], -second[inner], atol=2e-3 * np.abs(second[inner]).max()
        )


def test_weight_of_an_unbalanced_rotor_follows_its_angle():
    s = moving()
    at = table()["rotor.weight@rotor+psi+theta"].build(s, ())
    angle = s.phi_rad + 0.3
    force = np.cos(0.3) * at[0].force + np.sin(0.3) * at[1].force
    np.testing.assert_allclose(force[:, 0], -np.sin(angle), atol=1e-12)  # sum of y F
    np.testing.assert_allclose(force[:, 1], -np.cos(angle), atol=1e-12)  # sum of x F


def test_cogging_is_periodic_in_its_pitch_and_acts_on_the_drives_only():
    s = moving()
    effect = beam_friction_and_cogging.cogging(0.024)
    shifted = replace(s, x_b_m=s.x_b_m + 0.024)
    for one, other in zip(effect.build(s, (0.024,)), effect.build(shifted, (0.024,)), strict=True):
        assert one.parts[:3] == (None, None, None)
        np.testing.assert_allclose(one.drive, other.drive, atol=1e-12)


def test_grid_of_cogging_pitches_is_dense_enough():
    (cogging,) = (e for e in all_effects(rig_places()) if e.key == "cogging")
    lines = np.sort([1 / pitch for (pitch,) in cogging.grid])
    # Over 0.2 m of travel, lines closer than 1 / 0.2 m are correlated.
    assert np.diff(lines).max() * 0.2 < 1.5


def test_tone_has_its_phase_in_session_time():
    effect = vibration.tone(rig_places(), 50.0)[2]
    placed = Placed(effect, (50.0,), (3.0, 4.0))
    s = moving()
    np.testing.assert_allclose(
        placed.term(s).force[:, 2],
        5.0 * np.cos(2 * np.pi * 50 * s.time_s - np.arctan2(4.0, 3.0)),
        atol=1e-9,
    )


def test_stuck_sensor_keeps_its_last_reading():
    stuck = np.zeros((moving().rows, 9), bool)
    stuck[100:120, 4] = stuck[3000:3400, 4] = True
    s = replace(moving(), stuck=stuck)
    assert Extent.measured([moving(), s]).stuck == (4,)
    (stand,) = (e for e in all_effects(s.places) if e.identity == "sensor_stuck.stand@sensor:4")
    (found,) = stand.build(s, ())
    shown = s.gap(4) + found.gap[:, 4]
    assert np.all(shown[~stuck[:, 4]] == s.gap(4)[~stuck[:, 4]])
    np.testing.assert_allclose(shown[100:120], s.gap(4)[99], rtol=1e-12)
    np.testing.assert_allclose(shown[3000:3400], s.gap(4)[2999], rtol=1e-12)
    assert not np.any(np.delete(found.gap, 4, axis=1))
    # Without known stuck rows the effect is zero.
    assert not np.any(stand.build(moving(), ())[0].gap)


def test_beam_in_stiff_bearings_adds_only_its_inertia():
    """The force is -m q'', as the mass of the declared model has it, and zero at rest."""
    s = moving()
    stiff = (300.0, 0.5, 1.0, 0.06)
    for dof, axis in ((1, "theta"), (0, "psi")):
        found = term(f"friction.bearing@beam+{axis}", stiff).force
        assert not np.any(np.delete(found, dof, axis=1))
        qdd = s.qdd[:, dof]
        # At up to 7 Hz, far below 300 Hz, the shift is 1/2000 of the motion.
        off = found[200:, dof] + qdd[200:]
        assert np.std(off) < 0.02 * np.std(qdd)


def test_accelerated_beam_shifts_along_its_rails_only():
    still = replace(moving(), q=0 * moving().q, qd=0 * moving().qd, qdd=0 * moving().qdd)
    s = replace(still, a_b_m_s2=np.full(still.rows, 2.0))
    frequency, height = 30.0, 0.06
    shape = (frequency, 0.1, 1e3, height)
    along = term("friction.bearing@beam+theta", shape, s).force[:, 1]
    # The weight is shifted by a_b / w^2 from the position of the drives. The first part of Iwan's
    # curve deviates from linear by a_b / (h w^2) / (2 x_s) of the force, which is 1e-4.
    np.testing.assert_allclose(
        along, 9.81 / height * 2.0 / height / (2 * np.pi * frequency) ** 2, rtol=1e-3
    )
    assert not np.any(term("friction.bearing@beam+psi", shape, s).force)


def test_resonances_are_searched_below_the_nyquist_frequency():
    # At 50 Hz sampling, a resonance at 60 Hz has an alias at 10 Hz.
    places = rig_places()
    slow = replace(Extent.typical(places), fastest_hz=20.0)
    modes = [e for e in all_effects(places, slow) if e.effect_class == "flexible_mode"]
    assert {e.key for e in modes} == {"flexible_mode.loose_mass"}
    for effect in modes:
        assert [row[0] for row in effect.grid] == [7.5, 15.0]
        assert effect.shape[0].high == 20.0
    lines = {row[0] for e in all_effects(places, slow) if "vibration" in e.key for row in e.grid}
    assert lines == {50.0, 60.0}  # mains; other tones are found in the records


def test_terms_are_finite_for_records_without_commands():
    places = rig_places()
    s = moving()
    covered = Extent.measured([replace(s, coil=np.zeros_like(s.coil))])
    for effect in all_effects(places, covered):
        for term in effect.build(replace(s, coil=np.zeros_like(s.coil)), effect.grid[0]):
            assert all(np.isfinite(part).all() for part in term.parts if part is not None)
