"""Test both plant levels against Lagrange's equations of point masses and conservation laws."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from repository_folders import SIMS

from levid.config.base import load_yaml
from levid.config.sim import SimConfig
from levid.sim import plant_kernels as k
from levid.sim.plant_arrays import Arrays

G = 9.81
Array = NDArray[np.float64]


def rig(**imperfections: object) -> SimConfig:
    """rig.yaml with stops out of reach, without friction, and with these imperfections."""
    config = load_yaml(SIMS / "rig.yaml", SimConfig).model_dump()
    config["end_stops"]["travel_m"] = 10.0
    config["nonlinear"] |= imperfections
    for drive in ("beam_drive", "rotor_drive"):
        config["nonlinear"][drive] |= {"coulomb": 0.0, "viscous": 0.0}
    return SimConfig.model_validate(config)


def without_imperfections() -> SimConfig:
    none = dict.fromkeys(
        ("rods_cubic_psi_n_m_rad3", "rods_cubic_theta_n_m_rad3", "rods_cubic_z_n_m3"), 0.0
    )
    return rig(com_m=(0, 0, 0), rotor_imbalance_kg_m=0, coil_gain=(), coil_slope_1_m=0, **none)


def cloud(config: SimConfig) -> tuple[Array, Callable[[Array], Array]]:
    """Point masses (P,) with the rig's inertia, and their positions in space (P, 3) over x (5,)."""
    assert config.nonlinear is not None
    p, more, bar = config.platform, config.nonlinear, config.rotor.j_kg_m2
    ix, iy, iz = p.j_psi_kg_m2, p.j_theta_kg_m2 - bar, more.j_z_kg_m2 - bar
    # Second moments of the platform from its moments of inertia; six points have them.
    moments = np.diag([iy + iz - ix, ix + iz - iy, ix + iy - iz]) / 2.0
    moments[0, 1] = moments[1, 0] = p.j_psitheta_kg_m2
    com = np.asarray(more.com_m)
    root = np.linalg.cholesky((moments - p.m_p_kg * np.outer(com, com)) * 3.0 / p.m_p_kg)
    body = np.concatenate([com + root.T, com - root.T])
    # Bar and imbalance as points 5 cm and 12 cm off the axis with zero total mass.
    s, a, b = more.rotor_imbalance_kg_m, 0.05, -0.12
    m_a, m_b = (bar - s * b) / (a * (a - b)), (bar - s * a) / (b * (b - a))
    masses = np.array([p.m_p_kg / 6] * 6 + [config.beam.m_b_kg, m_a, m_b, -m_a - m_b])

    def places(x: Array) -> Array:
        psi, theta, z, xb, phi = x
        one, nil, u = 1.0 + 0.0 * psi, 0.0 * psi, np.array([np.cos(phi), np.sin(phi), 0.0 * phi])
        about_x = np.array(
            [[one, nil, nil], [nil, np.cos(psi), -np.sin(psi)], [nil, np.sin(psi), np.cos(psi)]]
        )
        about_minus_y = np.array(
            [
                [np.cos(theta), nil, -np.sin(theta)],
                [nil, one, nil],
                [np.sin(theta), nil, np.cos(theta)],
            ]
        )
        axis = np.array([xb, nil, more.rotor_z_m + nil])
        beam = np.array([xb, nil, config.beam.z_b_m + nil])
        points = np.concatenate([body, [beam, axis + a * u, axis + b * u, axis]])
        return points @ (about_minus_y @ about_x).T + np.array([nil, nil, z])

    return masses, places


def jacobian(places: Callable[[Array], Array], x: Array) -> Array:
    """d places / d x (P, 3, n) by complex steps, exact to rounding."""
    n = len(x)
    return np.stack([places(x + 1e-30j * np.eye(n)[j]).imag / 1e-30 for j in range(n)], axis=-1)


def equations(config: SimConfig, x: Array, v: Array) -> tuple[Array, Array]:
    """Mass matrix (5, 5) and the forces (5,) of gravity and motion, from the cloud."""
    masses, places = cloud(config)
    J = jacobian(places, x)
    eps = 1e-5
    bend = (jacobian(places, x + eps * v) - jacobian(places, x - eps * v)) @ v / (2 * eps)
    bend[:, 2] += G
    return np.einsum("p,pai,paj->ij", masses, J, J), -np.einsum("p,pai,pa->i", masses, J, bend)


def nonlinear_acceleration(a: Arrays, x: Array, v: Array, force: float, torque: float) -> Array:
    a.st[k.Q : k.Q + 5], a.st[k.V : k.V + 5] = x, v
    a.st[k.BEAM_LOOP + k.LOOP_FORCE], a.st[k.ROTOR_LOOP + k.LOOP_FORCE] = force, torque
    k.accelerations_nonlinear(a.par, a.st, a.coils)
    return a.st[k.A : k.A + 5].copy()


def test_nonlinear_level_obeys_lagranges_equations_of_a_point_cloud() -> None:
    config = rig(com_m=(0.004, -0.003, -0.01), rotor_imbalance_kg_m=5e-4, coil_slope_1_m=-5)
    assert config.nonlinear is not None
    a = Arrays.build(config, 1e-4)
    coil_x, coil_y = a.coils[k.COIL_X], a.coils[k.COIL_Y]
    rng = np.random.default_rng(1)
    for _ in range(20):
        x = rng.uniform(-1, 1, 5) * [0.3, 0.3, 0.01, 0.1, 3.0]
        v = rng.uniform(-1, 1, 5) * [2.0, 2.0, 0.5, 1.0, 30.0]
        currents, wrench = rng.uniform(-20, 20, coil_x.size), rng.uniform(-1, 1, 3)
        force, torque = rng.uniform(-1, 1, 2)
        a.coils[k.CURRENT] = currents
        a.st[k.WRENCH : k.WRENCH + 3] = wrench
        found = nonlinear_acceleration(a, x, v, force, torque)

        def heights(x: Array) -> Array:
            sx, sy = np.sin(x[0]), np.sin(x[1])
            return np.asarray(x[2] + coil_x * sy + coil_y * sx * np.cos(x[1]))

        rise = np.stack([heights(x + 1e-30j * np.eye(5)[j]).imag / 1e-30 for j in range(5)], 1)
        pushes = currents * a.coils[k.COIL_GAIN]
        pushes *= 1 + config.nonlinear.coil_slope_1_m * heights(x)
        pushes -= config.air.d_n_s_m * (rise @ v)
        cubic = a.par[k.CUBIC : k.CUBIC + 3] * x[:3] ** 3
        M, Q = equations(config, x, v)
        Q += rise.T @ pushes + np.array([*wrench, force, torque])
        Q[:3] -= a.par[k.K : k.K + 9].reshape(3, 3) @ x[:3] + cubic
        # Central differences of the cloud leave 1e-10 of the largest term, some 1e3.
        np.testing.assert_allclose(found, np.linalg.solve(M, Q), rtol=1e-6, atol=1e-5)


def test_nonlinear_level_conserves_energy_without_drive_and_damping() -> None:
    config = rig(com_m=(0.004, -0.003, -0.01), rotor_imbalance_kg_m=5e-4)
    a = Arrays.build(config, 1e-2)
    a.par[k.AIR_D] = 0.0
    for drive in (k.BEAM_DRIVE, k.ROTOR_DRIVE):
        a.par[drive : drive + 4] = 0.0
    x, v = np.array([0.05, -0.04, 0.0, 0.02, 0.3]), np.array([1.0, 0.5, 0.1, 0.2, 20.0])
    a.st[k.Q : k.Q + 5], a.st[k.V : k.V + 5] = x, v
    masses, places = cloud(config)
    K, cubic = a.par[k.K : k.K + 9].reshape(3, 3), a.par[k.CUBIC : k.CUBIC + 3]

    def energy() -> tuple[float, float]:
        x, v = a.st[k.Q : k.Q + 5], a.st[k.V : k.V + 5]
        speed = jacobian(places, x) @ v
        kinetic = 0.5 * float(masses @ (speed**2).sum(axis=1))
        potential = G * float(masses @ places(x)[:, 2]) + 0.5 * float(x[:3] @ K @ x[:3])
        return kinetic, kinetic + potential + 0.25 * float(cubic @ x[:3] ** 4)

    _, before = energy()
    none, swing = np.zeros(3), 0.0
    for _ in range(50):
        k.advance_nonlinear(
            a.par, a.st, a.coils, a.sensors, a.noise, a.out, np.zeros(a.coils.shape[1]), none, none
        )
        kinetic, after = energy()
        swing = max(swing, kinetic)
        # Runge-Kutta loses (w h)^5 / 144 a step: with w = 60 rad/s, 5e-13 x 5000 steps in all.
        assert abs(after - before) < 1e-8 * swing
    assert abs(a.st[k.Q + 3] - 0.02) > 0.01  # the beam slides


def test_declared_level_is_the_first_order_of_the_full_equations() -> None:
    """Around hovering (pose, rate and acceleration small), at any beam motion, the error is second
    order: the wrench that gives an acceleration exactly gives it in the declared model too, and
    the drive needs the force that it reports."""
    config = without_imperfections()
    a = Arrays.build(config, 1e-4)
    K, D = (a.par[at : at + 9].reshape(3, 3) for at in (k.K, k.D))
    rng = np.random.default_rng(2)
    for _ in range(10):
        beam = rng.uniform(-1, 1, 3) * [0.1, 1.0, 20.0]
        motion = rng.uniform(-1, 1, (3, 3)) * [[1, 1, 0.1], [10, 10, 1], [100, 100, 10]]
        errors = []
        for size in (1e-3, 1e-4):
            pose, rate, acceleration = size * motion
            x, v = np.array([*pose, beam[0], 0.0]), np.array([*rate, beam[1], 0.0])
            M, Q = equations(config, x, v)
            needed = M[:3, :3] @ acceleration + M[:3, 3] * beam[2] - Q[:3] + K @ pose + D @ rate
            a.st[k.Q : k.Q + 5], a.st[k.V : k.V + 5], a.st[k.A + 3] = x, v, beam[2]
            a.st[k.WRENCH : k.WRENCH + 3] = needed
            k.accelerations_declared(a.par, a.st, a.coils)
            k.measure_declared(a.par, a.st, a.coils, a.sensors, a.noise, a.out)
            drive = M[3, :3] @ acceleration + M[3, 3] * beam[2] - Q[3]
            errors.append(
                max(np.abs(a.st[k.A : k.A + 3] - acceleration).max(), abs(a.out[-4] - drive))
            )
        # A wrong first-order term gives a ratio of 10; second-order errors give 100.
        assert errors[1] < errors[0] / 60
        assert errors[0] < 1e-2  # of accelerations up to 0.1 rad/s^2


def test_moving_beam_conserves_angular_momentum() -> None:
    """Coriolis and M-dot terms: without outer forces the momenta of the whole are constant."""
    config = load_yaml(SIMS / "nominal.yaml", SimConfig)
    config = config.model_copy(
        update={"end_stops": config.end_stops.model_copy(update={"travel_m": 1e3})}
    )
    a = Arrays.build(config, 1e-3)
    a.par[k.G] = 0.0
    a.par[k.K : k.K + 9] = a.par[k.D : k.D + 9] = a.par[k.AMPLIFIER_NOISE] = 0.0
    xb, vb = -0.1, 1.0
    a.st[:] = 0.0
    a.st[k.Q : k.Q + 5], a.st[k.V : k.V + 5] = [0, 1e-3, 2e-4, xb, 0], [0, 0.05, 0.01, vb, 0]
    a.st[k.BEAM_TO : k.BEAM_TO + 3] = xb, vb, 0.0
    m, z_b = config.beam.m_b_kg, config.beam.z_b_m
    total = config.platform.m_p_kg + m
    J = config.platform.j_theta_kg_m2 + m * z_b**2
    a.par[k.J_PSITHETA] = 0.0  # otherwise theta drives psi, which has momentum too

    def momenta() -> Array:
        _, th, z, x, _ = a.st[k.Q : k.Q + 5]
        _, th_t, z_t, _, _ = a.st[k.V : k.V + 5]
        vertical = total * z_t + m * (x * th_t + vb * th)
        # About a fixed point of the z axis, counted about -y: x times up minus up times along.
        angular = J * th_t + m * x * (z_t + x * th_t) - m * z * vb
        return np.array([vertical, angular])

    before = momenta()
    for i in range(100):
        ref = np.array([xb + vb * (i + 1) * 1e-3, vb, 0.0])
        k.advance_declared(
            a.par, a.st, a.coils, a.sensors, a.noise, a.out,
            np.zeros(a.coils.shape[1]), ref, np.zeros(3),
        )  # fmt: skip
    # To rounding and Runge-Kutta at 0.1 ms, while the inertia falls by 20 percent.
    np.testing.assert_allclose(momenta(), before, rtol=1e-9)
    assert a.st[k.V + 1] != pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize(("xb", "ab", "sign"), [(0.05, 0.0, -1), (0.0, 5.0, +1)])
def test_beam_weight_tilts_down_and_reaction_tilts_up(xb: float, ab: float, sign: int) -> None:
    """Beam at +x: theta torque -m_b g x_b. Beam accelerating to +x: + m_b z_b a_b."""
    config = load_yaml(SIMS / "nominal.yaml", SimConfig)
    a = Arrays.build(config, 1e-3)
    a.st[:] = 0.0
    a.st[k.Q + 3], a.st[k.A + 3] = xb, ab
    k.accelerations_declared(a.par, a.st, a.coils)
    m, z_b = config.beam.m_b_kg, config.beam.z_b_m
    p = config.platform
    M = np.array(
        [
            [p.j_psi_kg_m2 + m * z_b**2, p.j_psitheta_kg_m2, 0],
            [p.j_psitheta_kg_m2, p.j_theta_kg_m2 + m * (z_b**2 + xb**2), m * xb],
            [0, m * xb, p.m_p_kg + m],
        ]
    )
    tau = M @ a.st[k.A : k.A + 3]
    expected = [0.0, sign * m * (G * xb + z_b * ab), -G * (p.m_p_kg + m)]
    np.testing.assert_allclose(tau, expected, rtol=1e-12, atol=1e-12)
