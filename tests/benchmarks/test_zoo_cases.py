"""The zoo of benchmarks/: it holds every shipped effect, loads, scales; and the unlisted ones."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from rig_effects import CLASSES, shipped_effects

from levid.benchmarks.trace import (
    unlisted_effects,
    unlisted_effects_2,
    unlisted_effects_4,
    unlisted_effects_7,
    unlisted_effects_8,
    unlisted_effects_9,
    zoo_cases,
)
from levid.config.sim import SimEffect
from levid.sim.effects import BeamState, Effects

DT = 1e-4
KINDS = CLASSES | {"unknown"}
PLACES = {"psi", "theta", "z", "beam", "rotor"} | {
    f"{what}:{i}" for what in ("coil", "sensor") for i in range(9)
}


ZOO, UNLISTED = zoo_cases, unlisted_effects
UNLISTED_2, UNLISTED_4 = unlisted_effects_2, unlisted_effects_4
UNLISTED_7, UNLISTED_8 = unlisted_effects_7, unlisted_effects_8
UNLISTED_9 = unlisted_effects_9
EVERY = ZOO.CASES + ZOO.UNLISTED


@pytest.mark.parametrize("case", EVERY, ids=lambda case: case.name)
def test_case_loads_and_grows(case) -> None:
    assert {case.kind, *case.alike} <= KINDS
    assert set(case.where) <= PLACES
    assert case.size
    Effects([SimEffect.model_validate(case.effect(scale)) for scale in (0.5, 1.0, 4.0)], None)
    once, twice = case.effect(1.0), case.effect(2.0)
    assert set(once) == set(twice) == {"use", *case.values}
    for key, value in case.values.items():
        factor = 2.0 ** case.size.get(key, 0.0)
        if isinstance(value, str):
            assert twice[key] == value
        else:
            np.testing.assert_allclose(twice[key], factor * np.array(value))


def test_names_are_unique_and_classes_all_there() -> None:
    assert len({case.name for case in EVERY}) == len(EVERY)
    assert KINDS - {case.kind for case in EVERY} == set()
    assert {case.kind for case in ZOO.UNLISTED} == {"unknown"}


def test_every_shipped_effect_is_in_the_zoo() -> None:
    shipped = {f"levid.sim.effects.{use}" for use in shipped_effects()}
    assert shipped == {case.use for case in ZOO.CASES}


def test_hung_plug_takes_up_its_own_frequency() -> None:
    """Shaken at its own frequency it pushes 1 / (2 zeta) times as hard as its mass would."""
    f, zeta, m = 14.0, 0.03, 0.01
    plug = UNLISTED.HungPlug(m, f, zeta, x_m=0.0, y_m=0.1)
    plug.reset(SimpleNamespace(dt_s=DT))
    omega, force = 2 * np.pi * f, []
    t = np.arange(round(3 / DT)) * DT
    for s in t:
        z, v = 1e-4 * np.sin(omega * s), 1e-4 * omega * np.cos(omega * s)
        force.append(plug.wrench(s, [0, 0, z], [0, 0, v], None))
    settled = np.array(force)[-10_000:]
    np.testing.assert_allclose(settled[:, 0], 0.1 * settled[:, 2])
    # sqrt(1 + 4 zeta^2) is 1.002; an Euler step of 0.0088 rad shifts the peak by less than 2 %.
    assert np.abs(settled[:, 2]).max() == pytest.approx(m * omega**2 * 1e-4 / (2 * zeta), rel=0.02)


def test_eddy_brake_brakes_near_its_magnet_alone() -> None:
    brake = UNLISTED.EddyBrake(2.0, at_m=0.02, width_m=0.01)
    near = brake.wrench(0, np.zeros(3), [0, 1.0, 0.5], BeamState(0.02, 0, 0, 0, 0, 0))
    np.testing.assert_allclose(near, [0, 0.02 * -2 * 0.52, -2 * 0.52])
    far = brake.wrench(0, np.zeros(3), [0, 1.0, 0.5], BeamState(0.09, 0, 0, 0, 0, 0))
    assert np.abs(far).max() < 1e-15


def test_gyroscope_does_no_work() -> None:
    gyro, qd = UNLISTED.Gyroscope(1e-3), np.array([0.2, -0.3, 0.1])
    tau = gyro.wrench(0, np.zeros(3), qd, BeamState(0, 0, 0, 0, 12.0, 0))
    assert np.abs(tau).max() == pytest.approx(1e-3 * 12 * 0.3)
    assert abs(np.dot(tau, qd)) < 1e-18


def test_stray_field_is_none_at_rest_and_even() -> None:
    field = UNLISTED.StrayField(sensor=7, coil=4, offset_m=1e-5, rest_n=8.0)
    field.reset(None)
    off = field.gap(0, np.zeros(9))
    for force, seen in ((8.0, 0.0), (12.0, 1.25e-5), (-12.0, 1.25e-5), (0.0, off[7])):
        forces = np.full(9, 5.0)
        forces[4] = force
        np.testing.assert_array_equal(field.coil_force(0, np.zeros(3), forces.copy()), forces)
        gap = field.gap(0, np.zeros(9))
        assert gap[7] == pytest.approx(seen, abs=1e-18)
        assert np.count_nonzero(np.delete(gap, 7)) == 0


def test_shared_yoke_takes_from_one_what_the_other_carries_beyond_rest() -> None:
    yoke = UNLISTED.SharedYoke(coil=5, neighbour=8, loss=0.02, rest_n=8.0)
    rest = np.full(9, 8.0)
    np.testing.assert_array_equal(yoke.coil_force(0, np.zeros(3), rest.copy()), rest)
    forces = np.arange(9.0) + 4.0  # 12 at the neighbour
    given = yoke.coil_force(0, np.zeros(3), forces.copy())
    assert given[5] == pytest.approx(forces[5] * (1 - 0.02 * 0.5))
    np.testing.assert_array_equal(np.delete(given, 5), np.delete(forces, 5))


def test_cable_loop_lies_behind_after_the_beam_turns() -> None:
    """Its torque depends on the way the beam came: the same place, either sign, at any speed."""
    loop = UNLISTED.CableLoop(0.1, play_m=2e-3)
    loop.reset(None)
    torque = []
    for x in (0.0, 1e-3, 0.05, 0.04, 0.039, -0.03, 0.04, 0.04):
        *others, force = loop.wrench(0, np.zeros(3), np.zeros(3), BeamState(x, 0, 0, 0, 0, 0))
        assert (others[0], force) == (0.0, 0.0)
        torque.append(others[1])
    most = 0.1 * 9.81 * 2e-3
    np.testing.assert_allclose(torque, np.array([0, 0.5, 1, -1, -1, -1, 1, 1]) * most, atol=1e-15)


def test_closed_cover_presses_ahead_of_the_beam_as_much_as_it_lifts_behind() -> None:
    """The torque is that of the pressures, which leak as much out as in, and goes with v |v|."""
    cover = UNLISTED_2.ClosedCover(zeta=40.0, width_m=0.24, half_length_m=0.14)
    for x, v in ((0.0, 0.3), (0.07, 0.3), (0.07, -0.3), (-0.1, 0.15), (0.05, 0.0)):
        dp = 0.5 * 1.2 * 40 * v * abs(v)
        at = (np.arange(2800) + 0.5) * 1e-4 - 0.14
        p = np.where(at > x, dp * (0.14 + x), -dp * (0.14 - x)) / 0.28
        lift = -0.24 * 1e-4 * p
        assert lift.sum() == pytest.approx(0.0, abs=1e-12)
        tau = cover.wrench(0, np.zeros(3), np.zeros(3), BeamState(x, v, 0, 0, 0, 0))
        np.testing.assert_allclose(tau, [0, lift @ at, 0], rtol=1e-5, atol=1e-15)


def test_pulled_oscillator_shows_its_neighbour_while_it_is_locked() -> None:
    lock, apart = 2e-5, 5e-5
    pulled = UNLISTED_2.PulledOscillator(sensor=7, neighbour=8, lock_m=lock, apart_m=apart)

    def error(off: float) -> float:
        gap = np.arange(9.0) * 1e-6
        gap[7] = gap[8] + apart + off
        seen = pulled.gap(0, gap.copy())
        np.testing.assert_array_equal(np.delete(seen, 7), np.delete(gap, 7))
        return float(seen[7] - gap[7])

    for s in (-0.9, 0.0, 0.4):
        assert error(s * lock) == pytest.approx(-s * lock, abs=1e-18)
    assert error(1.25 * lock) == pytest.approx(-0.5 * lock)  # slips at three fifths of its way
    assert error(-1.25 * lock) == pytest.approx(0.5 * lock)
    assert error(20 * lock) == pytest.approx(-lock / 40, rel=1e-3)


def test_pulled_oscillator_averages_the_beats_of_adler() -> None:
    """s = 1.5 in phi' = s - sin(phi): the mean of sin(phi) is what the reading lacks, over L."""
    phi, pull, dt = 0.0, [], 1e-3
    for _ in range(200_000):
        middle = phi + 0.5 * dt * (1.5 - np.sin(phi))
        pull.append(np.sin(middle))
        phi += dt * (1.5 - pull[-1])
    gap = np.zeros(9)
    gap[7] = 1.5e-5
    seen = UNLISTED_2.PulledOscillator(7, 8, lock_m=1e-5, apart_m=0.0).gap(0, gap)
    assert seen[7] == pytest.approx(1.5e-5 - 1e-5 * np.mean(pull), rel=0.01)


def test_second_stage_stays_on_between_its_two_currents() -> None:
    stage = UNLISTED_2.SecondStage(coil=3, step_n=0.1, on_n=9.0, off_n=8.0)
    for _ in range(2):  # a second flight begins as the first
        stage.reset(None)
        steps = []
        for force in (8.5, 9.0, 8.5, 8.01, 8.0, 8.99, 12.0, -3.0):
            forces = np.full(9, 20.0)
            forces[3] = force
            given = stage.coil_force(0, np.zeros(3), forces.copy())
            np.testing.assert_array_equal(np.delete(given, 3), np.delete(forces, 3))
            steps.append(given[3] - force)
        np.testing.assert_allclose(steps, 0.1 * np.array([0, 1, 1, 1, 0, 0, 1, 0]), atol=1e-14)
    with pytest.raises(ValueError, match="off_n"):
        UNLISTED_2.SecondStage(coil=3, step_n=0.1, on_n=8.0, off_n=9.0)


def test_loaded_rod_pulls_along_itself_with_what_accelerates_the_beam() -> None:
    """Its force lies along the line between its ends, and holds the platform against the beam."""
    rod = UNLISTED_4.LoadedRod(m_b_kg=1.4, length_m=0.05, level_m=2e-4)
    rod.reset(SimpleNamespace(dt_s=0.0))
    for z, a in ((0.0, 3.0), (0.0, -3.0), (5e-4, 3.0), (-3e-4, -2.0), (2e-4, 4.0), (5e-4, 0.0)):
        along = np.array([0.05, 2e-4 - z])
        tension = 1.4 * a * np.hypot(*along) / along[0]
        up = tension * along[1] / np.hypot(*along)
        tau = rod.wrench(0, [1e-3, -2e-3, z], np.ones(3), BeamState(0.1, 0.2, a, 1, 5, 9))
        np.testing.assert_allclose(tau, [0, 0, up], atol=1e-15)
    with pytest.raises(ValueError, match="length_m"):
        UNLISTED_4.LoadedRod(m_b_kg=1.4, length_m=0.0, level_m=0.0)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_loaded_rod_is_a_string_in_tension_and_a_falling_column_in_compression(way) -> None:
    """A mass swings about the level with w^2 = N / m L, or runs from it as cosh(w t); undamped."""
    rod = UNLISTED_4.LoadedRod(m_b_kg=1.4, length_m=0.05, level_m=2e-4)
    rod.reset(SimpleNamespace(dt_s=DT))
    omega = np.sqrt(1.4 * 4.0 / (7.0 * 0.05))
    beam, z, v, height = BeamState(0, 0, way * 4.0, 0, 0, 0), 3e-4, 0.0, []
    t = np.arange(round(2 / DT)) * DT
    for s in t:
        height.append(z)
        acceleration = rod.wrench(s, [0, 0, z], [0, 0, v], beam)[2] / 7.0
        z, v = z + DT * v + 0.5 * DT * DT * acceleration, v + DT * acceleration
    goes = np.cos(omega * t) if way > 0 else np.cosh(omega * t)
    np.testing.assert_allclose(height, 2e-4 + 1e-4 * goes, rtol=1e-4)


def test_wavy_rail_pushes_with_what_lifts_the_beam() -> None:
    """Along a way of varying speed the force is the mass times the wave's second difference."""
    rail = UNLISTED_7.WavyRail(height_m=4e-6, period_m=0.02, phase_rad=0.7, m_b_kg=1.4)
    dt = 1e-4
    t = np.arange(5000) * dt
    x, v, a = 0.08 * np.sin(4 * t), 0.32 * np.cos(4 * t), -1.28 * np.sin(4 * t)
    height = 4e-6 * np.cos(2 * np.pi * x / 0.02 + 0.7)
    wanted = -1.4 * np.diff(height, 2) / dt**2
    at = zip(x[1:-1], v[1:-1], a[1:-1], strict=True)
    tau = [rail.wrench(0, np.ones(3), np.ones(3), BeamState(*xva, 1, 5, 9)) for xva in at]
    np.testing.assert_allclose(np.array(tau)[:, 2], wanted, atol=1e-3 * np.abs(wanted).max())
    np.testing.assert_allclose(np.array(tau)[:, 1], x[1:-1] * np.array(tau)[:, 2])
    assert not np.array(tau)[:, 0].any()
    still = rail.wrench(0, np.ones(3), np.ones(3), BeamState(0.03, 0, 0, 1, 5, 9))
    np.testing.assert_array_equal(still, np.zeros(3))
    with pytest.raises(ValueError, match="period_m: expected a number above 0, found 0"):
        UNLISTED_7.WavyRail(height_m=4e-6, period_m=0.0, phase_rad=0.0, m_b_kg=1.4)


def test_warm_post_grows_with_the_square_of_what_its_coil_carries() -> None:
    """From cold to rest it is a warm-up, and once warm the gap is right; a load shows later."""
    post = UNLISTED_7.WarmPost(sensor=2, coil=6, growth_m=8e-6, rest_n=7.5, time_constant_s=0.1)
    post.reset(SimpleNamespace(dt_s=DT))

    def seen(force: float, seconds: float) -> float:
        for _ in range(round(seconds / DT)):
            forces = np.full(9, 3.0)
            forces[6] = force
            np.testing.assert_array_equal(post.coil_force(0, np.zeros(3), forces.copy()), forces)
        gap = post.gap(0, np.zeros(9))
        assert not np.delete(gap, 2).any()
        return float(gap[2])

    assert seen(7.5, 0.0) == pytest.approx(8e-6)
    assert seen(7.5, 0.1) == pytest.approx(8e-6 * np.exp(-1))
    assert seen(-7.5, 2.0) == pytest.approx(0.0, abs=1e-13)
    assert seen(9.0, 0.05) == pytest.approx(-8e-6 * 0.44 * (1 - np.exp(-0.5)))
    for name in ("rest_n", "time_constant_s"):
        values = {"rest_n": 7.5, "time_constant_s": 44.0, name: -1.0}
        with pytest.raises(ValueError, match=f"{name}: expected a number above 0, found -1.0"):
            UNLISTED_7.WarmPost(sensor=2, coil=6, growth_m=8e-6, **values)


ROCKING = {"damping": 0.08, "height_m": 0.4, "j_kg_m2": 0.058, "m_b_kg": 1.4, "z_b_m": 0.06}


def _rock(x_m, a_m_s2, dt_s=DT):
    """Return the wrench (N, 3) of a table of 14 kg m^2 at 2 Hz as the beam goes this way."""
    table = UNLISTED_8.RockingTable(14.0, 2.0, **ROCKING)
    table.reset(SimpleNamespace(dt_s=dt_s))
    ways = zip(x_m, a_m_s2, strict=True)
    beams = (BeamState(x, 0.3, a, 1, 5, 9) for x, a in ways)
    return np.array([table.wrench(0, np.ones(3), np.ones(3), beam) for beam in beams])


def test_rocking_table_leaves_the_platform_behind() -> None:
    """Swung evenly it answers as 1 / (k - w^2 J_t + i w c); beam and platform keep their places."""
    omega, k = 2 * np.pi * 0.9, 14 * (4 * np.pi) ** 2
    t = np.arange(round(12 / DT)) * DT
    x, a = 0.1 * np.sin(omega * t), -0.1 * omega**2 * np.sin(omega * t)
    reply = 1 / (k - 14 * omega**2 + 2j * omega * 0.08 * 14 * 4 * np.pi)
    tilt = np.imag(-1.4 * 0.1 * (0.4 * omega**2 + 9.81) * reply * np.exp(1j * omega * t))
    # In the room: heights h of the beam and h - z_b of the platform's middle over the axis; to
    # first order in the tilt, against what the table's own sensors and motors know, about -y.
    along, up = -0.4 * -(omega**2) * tilt, x * -(omega**2) * tilt
    push_x, push_z = -1.4 * (along + 9.81 * tilt), -1.4 * up
    torque = 0.058 * omega**2 * tilt + x * push_z - 0.06 * push_x
    settled = slice(-round(4 / DT), None)
    tau = _rock(x, a)[settled]
    assert not tau[:, 0].any()
    np.testing.assert_allclose(tau[:, 1], torque[settled], atol=5e-3 * np.abs(torque).max())
    np.testing.assert_allclose(tau[:, 2], push_z[settled], atol=5e-3 * np.abs(push_z).max())


def test_rocking_table_rings_after_a_push_and_rests_with_the_beam() -> None:
    still = _rock(np.full(20, 0.08), np.zeros(20))
    weight = 1.4 * 9.81 * 0.08 / (14 * (4 * np.pi) ** 2)  # it leans, and the beam's weight with it
    np.testing.assert_allclose(still[:, 1], -1.4 * 9.81 * 0.06 * weight)
    np.testing.assert_allclose(still[:, 2], 0.0, atol=1e-15)
    # At once as the mass that it is, 11 mN m; half a swing later the other way, and less.
    pushed = _rock(np.zeros(6000), np.full(6000, 3.0))[:, 1]
    at_once = -(0.058 + 1.4 * 0.06 * 0.4) * 1.4 * 0.4 * 3 / 14
    assert pushed[0] == pytest.approx(at_once)
    assert 0.7 < pushed.max() / -at_once < 1.0
    for name in ("table_j_kg_m2", "freq_hz"):
        values = {"table_j_kg_m2": 14.0, "freq_hz": 2.0, **ROCKING, name: 0.0}
        with pytest.raises(ValueError, match=f"{name}: expected a number above 0, found 0.0"):
            UNLISTED_8.RockingTable(**values)


def test_rectified_drive_shows_the_power_of_three_half_bridges() -> None:
    """Their sum's variance, from its pulses about a common centre, over a turn of the field."""

    def power(modulation: float) -> float:
        turn = (np.arange(120) + 0.5) / 120 * 2 * np.pi
        within = np.abs((np.arange(2000) + 0.5) / 2000 - 0.5)
        legs = turn[:, None] - np.arange(3) * 2 * np.pi / 3
        shares = 0.5 + 0.5 * modulation * np.cos(legs)
        voltage = (within < 0.5 * shares[:, :, None]).sum(axis=1)
        return float(voltage.var(axis=1).mean())

    drive = UNLISTED_8.RectifiedDrive(sensor=3, offset_m=1e-5, end_speed_rad_s=25.0, motor_s=0.03)
    drive.reset(None)
    assert not drive.gap(0, np.zeros(9)).any()

    def seen(rate: float, acceleration: float) -> float:
        beam = BeamState(0.1, 0.3, 2, 1, rate, acceleration)
        assert drive.wrench(0, np.ones(3), np.ones(3), beam) == (0.0, 0.0, 0.0)
        gap = drive.gap(0, np.zeros(9))
        assert not np.delete(gap, 3).any()
        return float(gap[3])

    for rate, acceleration, share in ((18, 0, 0.72), (-18, 0, 0.72), (9, 50, 0.42), (9, -50, 0.3)):
        missing = power(share) / power(0.0) - 1.0
        assert seen(rate, acceleration) == pytest.approx(1e-5 * missing, rel=5e-3)
    assert seen(0, 0) == 0.0
    assert seen(18, 0) == pytest.approx(-5.3e-6, rel=2e-3)
    assert seen(40, 0) == seen(25, 0)
    with pytest.raises(ValueError, match="end_speed_rad_s: expected a number above 0, found 0"):
        UNLISTED_8.RectifiedDrive(sensor=3, offset_m=1e-5, end_speed_rad_s=0.0, motor_s=0.03)


SOFT_FEET = {
    "inertia_kg_m2": 50.0,
    "freq_hz": 4.0,
    "damping": 0.05,
    "height_m": 0.7,
    "off_m": 0.2,
    "m_b_kg": 1.5,
    "mass_kg": 6.0,
    "j_kg_m2": 0.1,
}


def test_table_on_soft_feet_rings_after_the_beam_pushed_off() -> None:
    """A sudden push is answered by (u / I) e^(-zeta w t) (cos - zeta w / w_d sin) of w_d t."""
    table = UNLISTED_9.RockingTable(**SOFT_FEET)
    dt, t = 1e-5, np.arange(40000) * 1e-5
    w, zeta = 2 * np.pi * 4.0, 0.05
    w_d = w * np.sqrt(1 - zeta**2)
    rings = np.exp(-zeta * w * t) * (np.cos(w_d * t) - zeta * w / w_d * np.sin(w_d * t))

    def felt(x_m: float, a_m_s2: float) -> np.ndarray:
        """Tell the wrench with the beam at x from t = 0 on, which stood at 0.05 m before."""
        table.reset(SimpleNamespace(dt_s=dt))
        before = table.wrench(0, np.ones(3), np.ones(3), BeamState(0.05, 0, 0, 1, 5, 9))
        np.testing.assert_allclose(before, np.zeros(3), atol=1e-15)
        beam = BeamState(x_m, 0.3, a_m_s2, 1, 5, 9)
        return np.array([table.wrench(0, np.ones(3), np.ones(3), beam) for _ in t])

    for x, a in ((0.05, 3.0), (-0.08, 0.0)):
        turned = 1.5 / 50.0 * (0.7 * a - 9.81 * (x - 0.05)) * rings
        tau = felt(x, a)
        near = 1e-3 * np.abs(turned).max()
        force_kg_m = 6.0 * 0.2 + 1.5 * (x + 0.2)
        torque_kg_m2 = 0.1 + 1.5 * x * (x + 0.2)
        np.testing.assert_allclose(tau[:, 2], -force_kg_m * turned, atol=near * force_kg_m)
        np.testing.assert_allclose(tau[:, 1], -torque_kg_m2 * turned, atol=near * torque_kg_m2)
        assert not tau[:, 0].any()
    for name in ("inertia_kg_m2", "freq_hz"):
        with pytest.raises(ValueError, match=f"{name}: expected a number above 0, found -1.0"):
            UNLISTED_9.RockingTable(**{**SOFT_FEET, name: -1.0})


def test_passed_coil_pushes_the_magnets_as_one_dipole_another() -> None:
    """The force is the slope along z of the energy of two upright dipoles."""
    coil = UNLISTED_9.PassedCoil(coil=5, share=0.02, at_m=0.01, apart_m=0.03)
    coil.reset(None)
    forces = np.arange(1.0, 10.0)
    np.testing.assert_array_equal(coil.coil_force(0, np.zeros(3), forces.copy()), forces)

    def energy(x_m: float, z_m: float) -> float:
        return (x_m**2 - 2 * z_m**2) / np.hypot(x_m, z_m) ** 5

    def force(x_m: float) -> float:
        return (energy(x_m, 0.03 - 1e-6) - energy(x_m, 0.03 + 1e-6)) / 2e-6

    for x in (-0.1, -0.02, 0.01, 0.02, 0.035, 0.06):
        tau = coil.wrench(0, np.ones(3), np.ones(3), BeamState(x, 0.3, 2, 1, 5, 9))
        np.testing.assert_array_equal(tau, np.zeros(3))
        pushed = coil.coil_force(0, np.zeros(3), forces.copy())
        share = 0.02 * force(x - 0.01) / force(0.0)
        assert pushed[5] / 6.0 - 1.0 == pytest.approx(share, rel=1e-6, abs=1e-9)
        np.testing.assert_array_equal(np.delete(pushed, 5), np.delete(forces, 5))
    with pytest.raises(ValueError, match="apart_m: expected a number above 0, found 0"):
        UNLISTED_9.PassedCoil(coil=5, share=0.02, at_m=0.01, apart_m=0.0)
