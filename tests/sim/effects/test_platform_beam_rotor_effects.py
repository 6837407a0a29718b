"""Test the equations of the shipped effects on platform, beam and rotor."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from effect_test_helpers import BEAM_Z_M as Z_B
from effect_test_helpers import DT_S as DT
from effect_test_helpers import R_M as R
from effect_test_helpers import fresh
from numpy.typing import NDArray
from scipy.linalg import expm

from levid.sim.effects import BeamState
from levid.sim.effects.air import QuadraticDamping, SqueezeFilm
from levid.sim.effects.beam import BeamCoriolis, BeamGravity, BeamReaction, MagnetField
from levid.sim.effects.bearing import BearingPlay, BearingPresliding
from levid.sim.effects.cable import BeamCable, HangingCable
from levid.sim.effects.friction import BoucWen, Coulomb, Dahl, LuGre, MaxwellSlip, Stribeck
from levid.sim.effects.ground_vibration import GroundNoise, GroundTone
from levid.sim.effects.mains import MainsForce
from levid.sim.effects.masses import CentreOfMass, Payload
from levid.sim.effects.motors import MotorCogging, MotorFriction
from levid.sim.effects.rotor import BarTorque, RotorImbalance
from levid.sim.effects.stiffness import BilinearRods, CubicRods, QuadraticRods

Array = NDArray[np.float64]
G = 9.81
ROWS = {"psi": 0, "theta": 1, "z": 2}
STILL = BeamState(0, 0, 0, 0, 0, 0)


def beam(x: float = 0, v: float = 0, a: float = 0, phi: float = 0, w: float = 0, dw: float = 0):
    return BeamState(x, v, a, phi, w, dw)


def pushed(effect: Any, dof: str, way: Array) -> Array:
    """Return the force F (n,) of an effect on one DOF along `way` (n,) in m, a step a value."""
    row, arm = ROWS[dof], 1.0 if dof == "z" else R
    forces = []
    for s, v in zip(way, np.gradient(way, DT), strict=True):
        q, qd = np.zeros(3), np.zeros(3)
        q[row], qd[row] = (s - 0.5 * DT * v) / arm, v / arm  # the effect leads by half a step
        tau = np.array(effect.wrench(0.0, q, qd, STILL))
        assert not np.delete(tau, row).any()
        forces.append(tau[row] / arm)
    return np.array(forces)


def swing(amplitude_m: float, freq_hz: float = 5.0, periods: float = 3) -> Array:
    t = np.arange(round(periods / freq_hz / DT)) * DT
    return amplitude_m * np.sin(2 * np.pi * freq_hz * t)


def lost(force: Array, way: Array) -> float:
    """Return the work in J that the effect absorbs along the path, by the trapezoidal rule."""
    return float(-np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(way)))


# --- rods and air: force over position and speed ---


@pytest.mark.parametrize("dof", ROWS)
@pytest.mark.parametrize(
    ("cls", "values", "force"),
    [
        (CubicRods, {"k3_n_m3": 2e9}, lambda s: -2e9 * s**3),
        (QuadraticRods, {"k2_n_m2": 3e5}, lambda s: -3e5 * s**2),
        (BilinearRods, {"k_n_m": 40.0}, lambda s: -40.0 * np.maximum(s, 0)),
    ],
)
def test_rods_follow_their_curve(cls, values, force, dof: str) -> None:
    effect, way = fresh(cls(dof=dof, **values)), np.linspace(-6e-4, 6e-4, 41)
    # Rounding, of a force of up to 0.4 N.
    np.testing.assert_allclose(pushed(effect, dof, way), force(way), rtol=1e-9, atol=1e-12)


def test_rods_at_a_tilt_are_a_torque_at_the_arm() -> None:
    """1 N/m^3 at the edge of the platform is r^4 N m/rad^3."""
    effect, psi = fresh(CubicRods("psi", 1e9)), 4e-3
    tau = effect.wrench(0.0, np.array([psi, 0, 0]), np.zeros(3), STILL)
    np.testing.assert_allclose(tau, [-1e9 * R**4 * psi**3, 0, 0], rtol=1e-12)


def test_spring_held_over_a_step_does_no_work() -> None:
    """Evaluated half a step ahead; at the step's begin it would feed in k dt / 2 as damping."""
    effect, omega = fresh(BilinearRods("z", 1e4)), 2 * np.pi * 20
    t = np.arange(round(1 / 20 / DT)) * DT
    s, v = 3e-4 * np.sin(omega * t), 3e-4 * omega * np.cos(omega * t)
    held = [
        effect.wrench(0.0, np.array([0, 0, a]), np.array([0, 0, b]), STILL)[2]
        for a, b in zip(s, v, strict=True)
    ]
    work = np.sum(held * (np.roll(s, -1) - s))
    late = np.sum(-1e4 * np.maximum(s, 0) * (np.roll(s, -1) - s))
    # What is left is of second order in omega dt = 0.013.
    assert abs(work) < 0.02 * abs(late)


def test_drag_goes_with_speed_squared_and_against_it() -> None:
    effect = fresh(QuadraticDamping("z", 50.0))
    for v in (-0.03, 0.02):
        tau = effect.wrench(0.0, np.zeros(3), np.array([0, 0, v]), STILL)
        assert tau[2] == pytest.approx(-50 * abs(v) * v)


def test_squeeze_film_damps_more_where_it_is_thin() -> None:
    """Nine coils at h, each d (g / (g + h))^3; at h = 0 the linear damper: 9 d, and 6 r^2 d."""
    effect = fresh(SqueezeFilm(2.0, 2e-3))
    for h in (-5e-4, 0.0, 5e-4):
        tau = effect.wrench(0.0, np.array([0, 0, h]), np.array([0, 0, 0.1]), STILL)
        np.testing.assert_allclose(tau, [0, 0, -9 * 2 * 0.1 / (1 + h / 2e-3) ** 3], atol=1e-12)
    tau = effect.wrench(0.0, np.zeros(3), np.array([0.1, 0, 0]), STILL)
    np.testing.assert_allclose(tau, [-6 * R**2 * 2 * 0.1, 0, 0], atol=1e-12)


# --- friction ---

FRICTIONS = {
    Coulomb: {"coulomb_n": 0.1, "speed_m_s": 1e-4},
    Stribeck: {"coulomb_n": 0.1, "static_n": 0.1, "stribeck_m_s": 1e-3, "speed_m_s": 1e-4},
    Dahl: {"coulomb_n": 0.1, "stiffness_n_m": 2e4},
    LuGre: {
        "coulomb_n": 0.1,
        "static_n": 0.1,
        "stribeck_m_s": 1e-3,
        "stiffness_n_m": 2e4,
        "damping_n_s_m": 0.0,
    },
    BoucWen: {"stiffness_n_m": 2e4, "yield_m": 5e-6},
    MaxwellSlip: {"stiffness_n_m": [1e4, 1e4], "slip_n": [0.04, 0.06]},
}


@pytest.mark.parametrize("cls", FRICTIONS)
@pytest.mark.parametrize("dof", ["z", "theta"])
def test_frictions_slide_at_their_level_and_lose_it_on_the_way(cls, dof: str) -> None:
    """All are set to slide at 0.1 N within some 20 um: over a swing of +-0.5 mm they lose close
    to 4 x 0.1 N x 0.5 mm a period, 5 percent less for turning round."""
    effect = fresh(cls(dof=dof, **FRICTIONS[cls]))
    way = swing(5e-4)
    force = pushed(effect, dof, way)
    assert np.abs(force).max() == pytest.approx(0.1, rel=1e-3)
    period = slice(len(way) // 3, 2 * len(way) // 3 + 1)
    assert lost(force[period], way[period]) == pytest.approx(4 * 0.1 * 5e-4, rel=0.05)


@pytest.mark.parametrize("cls", [Dahl, BoucWen, MaxwellSlip])
def test_hysteresis_is_a_spring_at_first_and_knows_no_rate(cls) -> None:
    k = {Dahl: 2e4, BoucWen: 2e4, MaxwellSlip: 2e4}[cls]
    way = swing(1e-4)
    first = pushed(fresh(cls(dof="z", **FRICTIONS[cls])), "z", way[:3])
    # 0.3 um of a way to slide of 5: at most 12 percent of the stiffness are gone.
    assert -first[2] / (way[2] - way[0]) == pytest.approx(k, rel=0.12)
    slow = pushed(fresh(cls(dof="z", **FRICTIONS[cls])), "z", swing(1e-4, freq_hz=2.5))
    fast = pushed(fresh(cls(dof="z", **FRICTIONS[cls])), "z", way)
    # The way is cut into half as long pieces: exact integration agrees but for where it turns.
    np.testing.assert_allclose(slow[::2], fast, atol=2e-4)


def test_stribeck_and_lugre_agree_at_constant_speed() -> None:
    """In sliding LuGre's bristles carry g(v), Stribeck's curve."""
    curve = {"coulomb_n": 0.1, "static_n": 0.2, "stribeck_m_s": 4e-3}
    lugre = LuGre("z", **curve, stiffness_n_m=2e4, damping_n_s_m=0.3)
    for v in (1e-3, 4e-3, 2e-2):
        way = v * np.arange(3000) * DT
        slides = pushed(fresh(lugre), "z", way)[-1]
        static = pushed(fresh(Stribeck("z", **curve, speed_m_s=1e-6)), "z", way)[-1]
        assert slides == pytest.approx(static, rel=1e-6)


def test_bouc_wen_keeps_a_share_of_its_stiffness() -> None:
    effect = fresh(BoucWen("z", 1e4, yield_m=1e-5, left=0.2, exponent=2.0))
    way = np.linspace(0, 4e-4, 4000)
    force = pushed(effect, "z", way)
    # Far beyond yield z is 1 but for exp(-2 x 40).
    slope = np.polyfit(way[2000:], force[2000:], 1)[0]
    assert slope == pytest.approx(-0.2 * 1e4, rel=1e-6)
    assert force[-1] == pytest.approx(-1e4 * (0.2 * 4e-4 + 0.8 * 1e-5), rel=1e-6)


def test_maxwell_slip_returns_on_masing_s_curve() -> None:
    """The way back is the virgin curve, twice as large: F(s_0) - F = 2 f((s_0 - s) / 2)."""
    values = {"stiffness_n_m": [800, 500, 300], "slip_n": [0.02, 0.03, 0.04]}
    up = np.linspace(0, 2e-4, 400)
    way = np.concatenate([up, up[-2::-1]])
    force = -pushed(fresh(MaxwellSlip("z", **values)), "z", way)
    back = force[399] - force[399:]
    virgin = np.interp((way[399] - way[399:]) / 2, up, force[:400])
    np.testing.assert_allclose(back, 2 * virgin, atol=2e-4)  # half a step of the way at 1600 N/m


# --- cables and masses ---


def test_hanging_cable_is_a_force_at_a_point() -> None:
    effect = fresh(HangingCable(-0.2, 0.1, -0.05))
    assert effect.wrench(0.0, np.zeros(3), np.zeros(3), STILL) == pytest.approx([0.01, -0.02, -0.2])


def test_beam_cable_pulls_back_as_an_acceleration_would() -> None:
    """A pull of k x_b to -x turns the platform as the reaction to m_b a_b = k x_b does."""
    cable, at = fresh(BeamCable(stiffness_n_m=3.0, weight_n_m=0.0)), beam(x=0.08)
    reaction = fresh(BeamReaction(excess=1.0, m_b_kg=1.4))
    np.testing.assert_allclose(
        cable.wrench(0.0, np.zeros(3), np.zeros(3), at),
        reaction.wrench(0.0, np.zeros(3), np.zeros(3), beam(a=3.0 * 0.08 / 1.4)),
    )
    hung = fresh(BeamCable(stiffness_n_m=0.0, weight_n_m=2.0))
    weight = hung.wrench(0.0, np.zeros(3), np.zeros(3), at)
    np.testing.assert_allclose(weight, [0, -0.08 * 0.16, -0.16])


def test_centre_of_mass_couples_and_weighs() -> None:
    effect = CentreOfMass(5.6, x_m=1e-3, y_m=-2e-3)
    M = effect.mass(0.0)
    np.testing.assert_array_equal(M, M.T)
    np.testing.assert_allclose(M[:2, 2], [5.6 * -2e-3, 5.6 * 1e-3])
    tau = effect.wrench(0.0, np.zeros(3), np.zeros(3), STILL)
    np.testing.assert_allclose(tau, -G * M[:, 2])  # as if the platform fell with -g


def test_payload_is_a_point_mass_from_its_time_on() -> None:
    effect = Payload(0.1, x_m=0.05, y_m=-0.08, begin_s=2.0)
    assert not np.any(effect.mass(1.999))
    assert not np.any(effect.wrench(1.999, np.zeros(3), np.zeros(3), STILL))
    at = np.array([-0.08, 0.05, 1.0])
    np.testing.assert_allclose(effect.mass(2.0), 0.1 * np.outer(at, at))
    np.testing.assert_allclose(effect.wrench(2.0, at, at, STILL), -0.1 * G * at)


# --- beam and rotor ---


def test_beam_terms_are_shares_of_the_model_s() -> None:
    """Of m_b z_b a_b, of 2 m_b v_b theta' at (theta, z), of -m_b g x_b."""
    q, qd, at = np.array([1e-3, 2e-3, 0]), np.array([0.1, 0.3, 0.2]), beam(x=0.05, v=0.4, a=2.0)
    for cls, model in (
        (BeamReaction, [0, 1.4 * Z_B * 2.0, 0]),
        (BeamCoriolis, [0, -2 * 1.4 * 0.05 * 0.4 * 0.3, -2 * 1.4 * 0.4 * 0.3]),
        (BeamGravity, [0, -1.4 * G * 0.05, 0]),
    ):
        tau = fresh(cls(excess=0.1, m_b_kg=1.4)).wrench(0.0, q, qd, at)
        np.testing.assert_allclose(tau, 0.1 * np.array(model), rtol=1e-12)


def test_magnet_field_and_cogging_repeat_with_their_pitch() -> None:
    field = fresh(MagnetField(0.3, pitch_m=0.04, phase_rad=0.5))
    cogs = fresh(MotorCogging(0.3, pitch_m=0.04, phase_rad=0.5))
    for x in np.linspace(-0.1, 0.06, 9):
        here, on = beam(x=x), beam(x=x + 0.04)
        force = cogs.beam_force(0.0, here, np.zeros(3), np.zeros(3))
        assert force == pytest.approx(0.3 * np.sin(50 * np.pi * x + 0.5))
        tau = field.wrench(0.0, np.zeros(3), np.zeros(3), here)
        np.testing.assert_allclose(tau, [0, x * force, force])
        again = cogs.beam_force(0.0, on, np.zeros(3), np.zeros(3))
        assert again == pytest.approx(force, abs=1e-12)


def test_motor_friction_resists() -> None:
    effect = fresh(MotorFriction(0.4, speed_m_s=1e-3, viscous_n_s_m=2.0))
    for v in (-0.2, 0.3):
        force = effect.beam_force(0.0, beam(v=v), np.zeros(3), np.zeros(3))
        assert force == pytest.approx(-0.4 * np.sign(v) - 2.0 * v)  # tanh(200) is 1


def test_imbalance_is_the_weight_and_reaction_of_a_point() -> None:
    """s = m e: differentiate the point's way numerically and use m_b z_b a_b's rule for it."""
    s, z_r, phi, w, dw = 2e-4, 0.09, 0.7, 9.0, 40.0
    tau = fresh(RotorImbalance(s, z_r)).wrench(
        0.0, np.zeros(3), np.zeros(3), beam(phi=phi, w=w, dw=dw)
    )
    h = 1e-4
    angle = phi + w * np.array([-h, 0, h]) + dw * np.array([h, 0, h]) ** 2 / 2
    way = np.stack([np.cos(angle), np.sin(angle)])
    a_x, a_y = (way[:, 0] - 2 * way[:, 1] + way[:, 2]) / h**2
    expected = [s * (z_r * a_y - G * np.sin(phi)), s * (z_r * a_x - G * np.cos(phi)), 0]
    # Second differences: h^2 w^4 / 12 of some 10 rad/s^2, a relative 1e-6, and rounding.
    np.testing.assert_allclose(tau, expected, rtol=1e-5)


def test_bar_torque_needs_a_leaning_axis_and_an_acceleration() -> None:
    turning = beam(w=10.0, dw=100.0)
    assert not np.any(BarTorque(2e-4, 0, 0).wrench(0, np.zeros(3), np.zeros(3), turning))
    tau = BarTorque(2e-4, 0.02, 0.01).wrench(0, np.zeros(3), np.zeros(3), turning)
    np.testing.assert_allclose(tau, [-2e-2 * 0.02, 2e-2 * 0.01, 0])


# --- the beam on its bearing ---


def at_rest_tilted(effect: Any, tilt: float) -> Array:
    """Return the wrench after the tilt came slowly, over 0.5 s, and stayed for 0.5 s."""
    rise = np.concatenate([np.sin(np.linspace(0, np.pi / 2, 5000)) ** 2, np.ones(5000)])
    rates = np.gradient(rise, DT)
    for share, rate in zip(rise, rates, strict=True):
        q, qd = np.array([tilt * share] * 2 + [0]), np.array([tilt * rate] * 2 + [0])
        tau = effect.wrench(0.0, q, qd, STILL)
    return np.array(tau)


@pytest.mark.parametrize(("axis", "row"), [("x", 1), ("y", 0)])
def test_tilted_beam_sinks_into_its_bearing(axis: Any, row: int) -> None:
    """Way below slip: delta = -m g tilt / k turns the platform further by + (m g)^2 tilt / k."""
    k, m, tilt = 2e4, 1.4, 2e-3
    tau = at_rest_tilted(fresh(BearingPresliding(axis, m, k, slip_n=20, damping_n_s_m=40)), tilt)
    # Of eight springs that yield up to 2 mm none has within 1.4 um; Dynamics have died out.
    assert tau[row] == pytest.approx((m * G) ** 2 * tilt / k, rel=0.01)
    assert not np.delete(tau, row).any()


@pytest.mark.parametrize(("axis", "row"), [("x", 1), ("y", 0)])
def test_tilted_beam_falls_through_the_play_of_its_bearing(axis: Any, row: int) -> None:
    """At rest it lies on one contact: delta = -(play / 2 + m g tilt / k)."""
    k, m, tilt, play = 2e4, 1.4, 2e-3, 3e-6
    tau = at_rest_tilted(fresh(BearingPlay(axis, m, play, k, damping_n_s_m=150)), tilt)
    assert tau[row] == pytest.approx(m * G * (0.5 * play + m * G * tilt / k), rel=1e-3)
    assert not np.delete(tau, row).any()


def test_bearing_with_play_does_not_pull_at_the_beam() -> None:
    """A tilt that turns faster than the beam crosses the play leaves it without a force."""
    m, z = 1.4, Z_B
    effect = fresh(BearingPlay("x", m, play_m=1e-3, stiffness_n_m=1e6, damping_n_s_m=500))
    t = np.arange(1000) * DT
    omega = 2 * np.pi * 40.0
    theta, rate = 1e-4 * np.sin(omega * t), 1e-4 * omega * np.cos(omega * t)
    pairs = zip(theta, rate, strict=True)
    tau = np.array([effect.wrench(0.0, np.array([0, a, 0]), np.array([0, b, 0]), STILL)[1]
                    for a, b in pairs])  # fmt: skip
    # R = 0. Its weight's torque -m g delta replaces that of a rigid beam, m g z theta. In space it
    # moves by Y = delta - z theta, -g theta integrated twice.
    Y = -z * 1e-4 * omega * t + G * 1e-4 / omega**2 * (np.sin(omega * t) - omega * t)
    expected = -m * G * (Y + 2 * z * theta)
    np.testing.assert_allclose(tau, expected, atol=0.01 * np.abs(tau).max())


def test_stiff_bearing_leaves_the_plant_as_it_was() -> None:
    """What is taken off M and K comes back through the bearing: with theta'' = -w^2 theta the
    wrench makes up for the mass, (m z^2 theta'') on the left, to (w / w_bearing)^2 and k's own."""
    m, k, omega = 1.4, 3e6, 2 * np.pi * 5
    effect = fresh(BearingPresliding("x", m, k, slip_n=1e3, damping_n_s_m=2000))
    np.testing.assert_allclose(effect.mass(0.0), np.diag([0, -m * Z_B**2, 0]))
    t = np.arange(4000) * DT
    theta, rate = 2e-3 * np.sin(omega * t), 2e-3 * omega * np.cos(omega * t)
    tau = [
        effect.wrench(0.0, np.array([0, a, 0]), np.array([0, b, 0]), STILL)[1]
        for a, b in zip(theta, rate, strict=True)
    ]
    middle = 2e-3 * np.sin(omega * (t + DT / 2))
    rigid = m * Z_B**2 * omega**2 * middle
    settled = slice(2000, None)
    # (w / w_bearing)^2 is 5e-4, the delay of half a step 1.6e-3, m g / k z below either.
    assert np.abs(np.array(tau) - rigid)[settled].max() < 5e-3 * rigid.max()


def test_platform_and_beam_swing_as_lagrange_has_them() -> None:
    """Free vibration of theta and delta against the matrix exponential of

    L = J theta'^2 / 2 + m (delta' - z theta')^2 / 2 - k theta^2 / 2 - k_b delta^2 / 2
        - m g (delta theta - z theta^2 / 2),

    the beam's height being z + delta theta - z theta^2 / 2 to second order.
    """
    J, k, m, z, k_b = 0.058, 190.0, 1.4, Z_B, 2e5
    M = np.array([[J + m * z * z, -m * z], [-m * z, m]])
    K = np.array([[k - m * G * z, m * G], [m * G, k_b]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), np.zeros((2, 2))]])
    effect = fresh(BearingPresliding("x", m, k_b, slip_n=1e4, damping_n_s_m=0.0))
    inertia = J + m * z * z + effect.mass(0.0)[1, 1]
    n, theta, rate = 5000, 2e-3, 0.0
    expected = np.array([theta, 0.0, 0.0, 0.0])
    step, swing_by, swing_as = expm(A * DT), [], []
    for _ in range(n):
        tau = effect.wrench(0.0, np.array([0, theta, 0]), np.array([0, rate, 0]), STILL)[1]
        tilt = theta + rate * DT / 2
        accel = (tau - (k - m * G * z) * tilt) / inertia
        theta, rate = theta + rate * DT + accel * DT**2 / 2, rate + accel * DT
        expected = step @ expected
        swing_by.append(theta)
        swing_as.append(expected[0])
    # Half a second of both modes, 8.7 and 63 Hz: phases drift by (w dt)^2 / 24 of 2 pi 31 or so.
    np.testing.assert_allclose(swing_by, swing_as, atol=0.03 * 2e-3)


def test_bearing_loses_work_when_it_slips_a_little() -> None:
    omega = 2 * np.pi * 20
    t = np.arange(12 * 500) * DT
    theta = 3e-3 * np.minimum(t / 0.3, 1) * np.sin(omega * t)  # slowly: no free vibration after
    rate = np.gradient(theta, DT)
    loss = {}
    for slip in (1.5, 1e4):
        effect = fresh(BearingPresliding("x", 1.4, 1e5, slip_n=slip, damping_n_s_m=0.0))
        tau = [
            effect.wrench(0.0, np.array([0, a, 0]), np.array([0, b, 0]), STILL)[1]
            for a, b in zip(theta, rate, strict=True)
        ]
        loss[slip] = -np.sum(np.array(tau)[-1000:] * rate[-1000:]) * DT
    assert loss[1.5] > 1e-4
    # What a slow start leaves of the free vibration, and half a step of delay.
    assert abs(loss[1e4]) < 0.05 * loss[1.5]


# --- environment ---


def test_ground_acceleration_acts_on_all_levitated_masses() -> None:
    effect = fresh(GroundTone(0.2, 15.0, mass_kg=7.0, m_b_kg=1.4))
    t = 0.0123
    tau = effect.wrench(t, np.zeros(3), np.zeros(3), beam(x=0.05))
    rise = 0.2 * np.sin(2 * np.pi * 15.0 * (t + DT / 2))
    np.testing.assert_allclose(tau, [0, -1.4 * 0.05 * rise, -7.0 * rise])


def test_ground_noise_has_its_level_and_band() -> None:
    effect = fresh(GroundNoise(0.1, (10, 40), mass_kg=7.0, m_b_kg=1.4))
    rise = np.array([effect.acceleration(0.0) for _ in range(200_000)])
    # 20 s at 30 Hz of bandwidth are some 1200 independent values: 2 percent; four of those.
    assert rise.std() == pytest.approx(0.1, rel=0.08)
    power = np.abs(np.fft.rfft(rise)) ** 2
    freq = np.fft.rfftfreq(len(rise), DT)
    # Of 1 / (1 + x^4), a Butterworth flank, 0.78 lie within -3 dB, next to nothing octaves away.
    inside = power[(freq > 10) & (freq < 40)].sum() / power.sum()
    assert inside == pytest.approx(0.78, abs=0.05)
    assert power[(freq < 2) | (freq > 200)].sum() < 0.01 * power.sum()


def test_mains_hum_has_its_harmonics() -> None:
    effect = fresh(MainsForce("z", [0.2, 0.0, 0.1]))
    t = np.arange(10_000) * DT
    z = np.array([effect.wrench(s, np.zeros(3), np.zeros(3), STILL)[2] for s in t])
    lines = np.abs(np.fft.rfft(z)) * 2 / len(z)  # 1 Hz apart
    np.testing.assert_allclose(lines[[50, 100, 150]], [0.2, 0.0, 0.1], atol=1e-9)
    assert np.sum(lines > 1e-9) == 2


def test_drives_hold_what_pulls_at_the_beam_from_outside() -> None:
    cable, rotor = fresh(BeamCable(20.0, 0.0)), fresh(RotorImbalance(1e-3, 0.1))
    nowhere = np.zeros(3)
    at = beam(x=0.05, phi=0.7, w=30.0, dw=200.0)
    assert cable.beam_force(0.0, at, nowhere, nowhere) == pytest.approx(-1.0)
    # A force F along x on the beam turns the platform by -z F: at z_b the cable's, at z_r this one.
    push = rotor.beam_force(0.0, at, nowhere, nowhere)
    weight = -G * 1e-3 * np.cos(0.7)
    assert rotor.wrench(0.0, nowhere, nowhere, at)[1] - weight == pytest.approx(-0.1 * push)
    pull = cable.beam_force(0.0, at, nowhere, nowhere)
    assert cable.wrench(0.0, nowhere, nowhere, at)[1] == pytest.approx(-Z_B * pull)


@pytest.mark.parametrize("yields", [0.1, 3.0, 4.0, 6.0, 40.0, 1e4])
def test_bouc_wen_resists_however_far_a_step_goes(yields: float) -> None:
    friction = fresh(BoucWen("z", 1e4, 1e-5))
    forces = [friction.resistance(yields * 1e-5, 0.0) for _ in range(30)]
    assert min(forces) > 0.0
    if yields > 1.0:
        assert forces[-1] == pytest.approx(0.1, rel=1e-3)
