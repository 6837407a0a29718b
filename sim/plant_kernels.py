"""Compiled integration of both plant levels: N internal Runge-Kutta steps of one control period.

All compiled code and the layout of the arrays are in this one file.

Equations of motion, level `declared`. With small angles the beam, a point at (x_b, 0, z_b) of the
platform, is at height z + x_b th + z_b (1 - th^2/2 - psi^2/2) and at x = x_b (1 - th^2/2) - z_b th
in space. Lagrange's equations of (kinetic - potential), kept to first order in q with x_b, v_b, a_b
of any size, are

    M(x_b) q'' + (D + G) q' + (K + N) q = tau + f

with M of the paper's eq. (2) and D, K of eqs. (3) to (5). Of the beam's acceleration, the part
along the platform's normal, a_n = z'' + x_b th'' + 2 v_b th', gives m_b x_b a_n in the theta row;
along the vertical, where the z row counts, it is a_n + a_b th. So G has 2 m_b x_b v_b and 2 m_b v_b
in its theta column, and N has m_b a_b at (z, theta) alone: in the theta row, the vertical
acceleration a_b th at arm x_b is cancelled by the horizontal one, a_b, at arm z_b + x_b th.
f = [0, m_b z_b a_b - m_b g x_b, -(m_p + m_b) g].

Level `nonlinear`: q = [psi, theta, z], the beam's x_b and the rotor's phi are five degrees of
freedom of one Lagrangian. A point p of the platform is at R p + z e_z, R = R_-y(theta) R_x(psi).
In platform axes the vertical is n = (sin th, cos th sin psi, cos th cos psi), the angular velocity
is w = e_psi psi' + e_th th', e_psi = (1, 0, 0), e_th = (0, -cos psi, sin psi). With N the sum of
p x m (a + g n) and f the sum of m (a + g n) over all masses, Lagrange's equations read
e_psi . N = Q_psi, e_th . N = Q_th, n . f = Q_z, and e_x . f_b = Q_x for the beam, e_z . N_r = Q_phi
for the rotor about its axis. Coil forces are vertical, along the axis of the part on the base; the
rods take the horizontal force of a tilted coil. The coils' points of attack, the end stops and the
air dampers have the height h = z + x sin th + y sin psi cos th, so each force f gives f dh/dq. A
sensor is fixed to the base under the plane of the platform and reads
z + x tan th + y tan psi / cos th.

Coil currents lag the command: F(t) = F_c + (F_0 - F_c) e^(-t/lag). With its values at 0, 1/2 and 1
of a step of a third of the lag, the impulse would have an error of 4e-6. The three values used
instead give its moments, the integrals of F, (1-s) F and (1-s)^2 F over the step, exactly, and with
them velocity and position.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Return `function` compiled by numba at its first call, or read from numba's cache."""
    return cast(F, njit(cache=True, error_model="numpy")(function))


# par: constants of the plant and the period; a name is the index of the (first) value.
STEP, PERIOD, G, M_P, M_B, Z_B, J_PSI, J_THETA, J_PSITHETA = range(9)
LIMIT, DECAY, LAG_0, LAG_HALF, LAG_1, LAG_MEAN, AMPLIFIER_NOISE = range(9, 16)
SENSOR_NOISE, LSB, CODE_MAX, BEAM_LSB, ROTOR_LSB, J_ROTOR = range(16, 22)
STOP_TRAVEL, STOP_K, STOP_D, AIR_D = range(22, 26)
K, D = 26, 35  # (3, 3) each, row by row; K without gravity
COM, J_Z, IMBALANCE, ROTOR_Z, CUBIC, SLOPE = 44, 47, 48, 49, 50, 53
BEAM_DRIVE, ROTOR_DRIVE = 54, 63  # see the offsets below
DRIVE_KP, DRIVE_KI, DRIVE_KD, DRIVE_MASS, DRIVE_LIMIT = range(5)
DRIVE_FILTER, COULOMB, COULOMB_SPEED, VISCOUS = range(5, 9)
STOPS = 72  # x, y of each stop to the end of par

# st: state. DOF are psi, theta, z, beam, rotor.
Q, V, A = 0, 5, 10  # positions, velocities, accelerations (5) each
BEAM_FROM, BEAM_TO, ROTOR_FROM, ROTOR_TO = 15, 18, 21, 24  # setpoints: position, speed, accel.
BEAM_LOOP, ROTOR_LOOP = 27, 31  # see the offsets below
LOOP_FORCE, LOOP_INTEGRAL, LOOP_SPEED, LOOP_LAST = range(4)
WRENCH, MASS, BEAM_FORCE = 35, 38, 47  # from effects in this step: (3), (3, 3), one value
WORK = 48  # positions and velocities of the Runge-Kutta stage, then their change over the step
MATRIX = WORK + 20  # mass matrix (5, 5), lower triangle
STATE_SIZE = MATRIX + 25

# coils (rows, C) and sensors (rows, S)
COIL_X, COIL_Y, COIL_GAIN, COMMAND, CURRENT, NOISE, DELTA, MEAN = range(8)
COIL_ROWS = 8
SENSOR_X, SENSOR_Y, SENSOR_GAIN, SENSOR_OFFSET, GAP = range(5)
SENSOR_ROWS = 5


@compiled
def advance_declared(
    par: Array, st: Array, coils: Array, sensors: Array, noise: Array, out: Array,
    coil_n: Array, beam_ref: Array, rotor_ref: Array,
) -> None:  # fmt: skip
    """Integrate one period of the declared model with this command; `out` gets the readings."""
    n_steps = begin(par, st, coils, coil_n, beam_ref, rotor_ref)
    for i in range(n_steps):
        step_declared(par, st, coils, noise, i, n_steps)
    accelerations_declared(par, st, coils)
    gaps_declared(st, sensors)
    measure_declared(par, st, coils, sensors, noise, out)


@compiled
def advance_nonlinear(
    par: Array, st: Array, coils: Array, sensors: Array, noise: Array, out: Array,
    coil_n: Array, beam_ref: Array, rotor_ref: Array,
) -> None:  # fmt: skip
    """Integrate one period of the full equations with this command; `out` gets the readings."""
    n_steps = begin(par, st, coils, coil_n, beam_ref, rotor_ref)
    for i in range(n_steps):
        step_nonlinear(par, st, coils, noise, i, n_steps)
    accelerations_nonlinear(par, st, coils)
    gaps_nonlinear(st, sensors)
    measure_nonlinear(par, st, coils, sensors, noise, out)


@compiled
def begin(
    par: Array, st: Array, coils: Array, coil_n: Array, beam_ref: Array, rotor_ref: Array
) -> int:
    """Store the command of a period; return the number of internal steps.

    Raises:
        ValueError: a command has the wrong size or is not finite.
    """
    n_coils = coils.shape[1]
    if coil_n.size != n_coils or beam_ref.size != 3 or rotor_ref.size != 3:
        raise ValueError("command: expected coil_n (C,), beam_ref (3,), rotor_ref (3,)")
    total = 0.0
    for j in range(3):
        total += beam_ref[j] + rotor_ref[j]
        st[BEAM_FROM + j], st[BEAM_TO + j] = st[BEAM_TO + j], beam_ref[j]
        st[ROTOR_FROM + j], st[ROTOR_TO + j] = st[ROTOR_TO + j], rotor_ref[j]
    limit = par[LIMIT]
    for c in range(n_coils):
        total += coil_n[c]
        coils[COMMAND, c] = min(max(coil_n[c], -limit), limit)
    if not math.isfinite(total):
        raise ValueError("command: expected finite numbers in coil_n, beam_ref and rotor_ref")
    return int(par[PERIOD] / par[STEP] + 0.5)


@compiled
def hermite(st: Array, at: int, s: float, T: float) -> tuple[float, float, float]:
    """Return position, speed and acceleration at s in 0..1 between the setpoints `at`, `at + 3`.

    The quintic has the position, speed and acceleration of both setpoints, so the motion is smooth
    across setpoints.
    """
    p0, v0, a0 = st[at], st[at + 1] * T, st[at + 2] * T * T
    d, v1, a1 = st[at + 3] - p0, st[at + 4] * T, st[at + 5] * T * T
    c3 = 10.0 * d - 6.0 * v0 - 4.0 * v1 - 1.5 * a0 + 0.5 * a1
    c4 = -15.0 * d + 8.0 * v0 + 7.0 * v1 + 1.5 * a0 - a1
    c5 = 6.0 * d - 3.0 * (v0 + v1) - 0.5 * (a0 - a1)
    p = p0 + s * (v0 + s * (0.5 * a0 + s * (c3 + s * (c4 + s * c5))))
    v = v0 + s * (a0 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))
    a = a0 + s * (6.0 * c3 + s * (12.0 * c4 + s * 20.0 * c5))
    return p, v / T, a / (T * T)


@compiled
def draw_noise(par: Array, coils: Array, noise: Array, i: int) -> None:
    """Set the amplifier noise of each coil in internal step i."""
    n_coils = coils.shape[1]
    for c in range(n_coils):
        coils[NOISE, c] = par[AMPLIFIER_NOISE] * noise[i * n_coils + c]


@compiled
def mean_forces(par: Array, st: Array, coils: Array, noise: Array, i: int) -> None:
    """Set the mean force of each coil over internal step i, at the height at its begin."""
    draw_noise(par, coils, noise, i)
    for c in range(coils.shape[1]):
        command = coils[COMMAND, c]
        mean = command + (coils[CURRENT, c] - command) * par[LAG_MEAN] + coils[NOISE, c]
        height = st[Q + 2] + coils[COIL_Y, c] * st[Q] + coils[COIL_X, c] * st[Q + 1]
        coils[MEAN, c] = mean * coils[COIL_GAIN, c] * (1.0 + par[SLOPE] * height)


@compiled
def settle_currents(par: Array, coils: Array) -> None:
    """Advance the lagged currents to the end of the step."""
    for c in range(coils.shape[1]):
        command = coils[COMMAND, c]
        coils[CURRENT, c] = command + (coils[CURRENT, c] - command) * par[DECAY]


# --- level `declared` ---


@compiled
def move_declared(
    par: Array, st: Array, coils: Array, sensors: Array, noise: Array, i: int, n_steps: int
) -> bool:
    """Advance by internal step i, to accelerations and heights at its end; return if all finite."""
    step_declared(par, st, coils, noise, i, n_steps)
    accelerations_declared(par, st, coils)
    gaps_declared(st, sensors)
    total = 0.0
    for j in range(A + 5):
        total += st[j]
    return math.isfinite(total)


@compiled
def step_declared(par: Array, st: Array, coils: Array, noise: Array, i: int, n_steps: int) -> None:
    """Advance pose and currents by internal step i of n_steps (classical Runge-Kutta)."""
    draw_noise(par, coils, noise, i)
    # Wrenches of the commands, of the currents' lag, and of noise and effects.
    u0 = u1 = u2 = l0 = l1 = l2 = 0.0
    e0, e1, e2 = st[WRENCH], st[WRENCH + 1], st[WRENCH + 2]
    for c in range(coils.shape[1]):
        x, y, command = coils[COIL_X, c], coils[COIL_Y, c], coils[COMMAND, c]
        lack = coils[CURRENT, c] - command
        u0, u1, u2 = u0 + y * command, u1 + x * command, u2 + command
        l0, l1, l2 = l0 + y * lack, l1 + x * lack, l2 + lack
        held = coils[NOISE, c] + coils[DELTA, c]
        e0, e1, e2 = e0 + y * held, e1 + x * held, e2 + held
    u0, u1, u2 = u0 + e0, u1 + e1, u2 + e2

    h = par[STEP]
    q0, q1, q2, v0, v1, v2 = st[Q], st[Q + 1], st[Q + 2], st[V], st[V + 1], st[V + 2]
    xb, vb, ab = hermite(st, BEAM_FROM, i / n_steps, par[PERIOD])
    k = par[LAG_0]
    a0, a1, a2 = _declared(
        par, st, q0, q1, q2, v0, v1, v2, xb, vb, ab, u0 + k * l0, u1 + k * l1, u2 + k * l2
    )
    xb, vb, ab = hermite(st, BEAM_FROM, (i + 0.5) / n_steps, par[PERIOD])
    k, g = par[LAG_HALF], 0.5 * h
    t0, t1, t2 = u0 + k * l0, u1 + k * l1, u2 + k * l2
    w0, w1, w2 = v0 + g * a0, v1 + g * a1, v2 + g * a2
    b0, b1, b2 = _declared(
        par, st, q0 + g * v0, q1 + g * v1, q2 + g * v2, w0, w1, w2, xb, vb, ab, t0, t1, t2
    )
    x0, x1, x2 = v0 + g * b0, v1 + g * b1, v2 + g * b2
    c0, c1, c2 = _declared(
        par, st, q0 + g * w0, q1 + g * w1, q2 + g * w2, x0, x1, x2, xb, vb, ab, t0, t1, t2
    )
    xb, vb, ab = hermite(st, BEAM_FROM, (i + 1) / n_steps, par[PERIOD])
    k = par[LAG_1]
    y0, y1, y2 = v0 + h * c0, v1 + h * c1, v2 + h * c2
    d0, d1, d2 = _declared(
        par, st, q0 + h * x0, q1 + h * x1, q2 + h * x2, y0, y1, y2, xb, vb, ab,
        u0 + k * l0, u1 + k * l1, u2 + k * l2,
    )  # fmt: skip

    s = h / 6.0
    st[Q] = q0 + s * (v0 + 2.0 * (w0 + x0) + y0)
    st[Q + 1] = q1 + s * (v1 + 2.0 * (w1 + x1) + y1)
    st[Q + 2] = q2 + s * (v2 + 2.0 * (w2 + x2) + y2)
    st[V] = v0 + s * (a0 + 2.0 * (b0 + c0) + d0)
    st[V + 1] = v1 + s * (a1 + 2.0 * (b1 + c1) + d1)
    st[V + 2] = v2 + s * (a2 + 2.0 * (b2 + c2) + d2)
    st[Q + 3], st[V + 3], st[A + 3] = xb, vb, ab
    st[Q + 4], st[V + 4], st[A + 4] = hermite(st, ROTOR_FROM, (i + 1) / n_steps, par[PERIOD])
    settle_currents(par, coils)


@compiled
def accelerations_declared(par: Array, st: Array, coils: Array) -> None:
    """Set the accelerations at the end of a step, for the drives' force."""
    t0, t1, t2 = st[WRENCH], st[WRENCH + 1], st[WRENCH + 2]
    for c in range(coils.shape[1]):
        force = coils[CURRENT, c] + coils[NOISE, c] + coils[DELTA, c]
        t0, t1, t2 = t0 + coils[COIL_Y, c] * force, t1 + coils[COIL_X, c] * force, t2 + force
    st[A], st[A + 1], st[A + 2] = _declared(
        par, st, st[Q], st[Q + 1], st[Q + 2], st[V], st[V + 1], st[V + 2],
        st[Q + 3], st[V + 3], st[A + 3], t0, t1, t2,
    )  # fmt: skip


@compiled
def _declared(
    par: Array, st: Array, q0: float, q1: float, q2: float, v0: float, v1: float, v2: float,
    xb: float, vb: float, ab: float, t0: float, t1: float, t2: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return q'' for pose q, its rate v, beam x_b, v_b, a_b and wrench t."""
    mb, zb, g = par[M_B], par[Z_B], par[G]
    mx, tilt = mb * xb, zb * mb * g
    r0 = t0 + tilt * q0
    r1 = t1 + tilt * q1 + mb * zb * ab - mx * g - 2.0 * mx * vb * v1
    r2 = t2 - (par[M_P] + mb) * g - mb * (ab * q1 + 2.0 * vb * v1)
    r0 -= par[K] * q0 + par[K + 1] * q1 + par[K + 2] * q2
    r1 -= par[K + 3] * q0 + par[K + 4] * q1 + par[K + 5] * q2
    r2 -= par[K + 6] * q0 + par[K + 7] * q1 + par[K + 8] * q2
    r0 -= par[D] * v0 + par[D + 1] * v1 + par[D + 2] * v2
    r1 -= par[D + 3] * v0 + par[D + 4] * v1 + par[D + 5] * v2
    r2 -= par[D + 6] * v0 + par[D + 7] * v1 + par[D + 8] * v2
    for k in range(STOPS, par.size, 2):
        x, y = par[k], par[k + 1]
        force = stop_force(par, q2 + y * q0 + x * q1, v2 + y * v0 + x * v1)
        r0, r1, r2 = r0 + y * force, r1 + x * force, r2 + force
    m00 = par[J_PSI] + mb * zb * zb + st[MASS]
    m01, m02 = par[J_PSITHETA] + st[MASS + 1], st[MASS + 2]
    m10 = par[J_PSITHETA] + st[MASS + 3]
    m11 = par[J_THETA] + mb * (zb * zb + xb * xb) + st[MASS + 4]
    m12, m20, m21 = mx + st[MASS + 5], st[MASS + 6], mx + st[MASS + 7]
    m22 = par[M_P] + mb + st[MASS + 8]
    # Cramer's rule.
    c00, c01, c02 = m11 * m22 - m12 * m21, m12 * m20 - m10 * m22, m10 * m21 - m11 * m20
    c10, c11, c12 = m02 * m21 - m01 * m22, m00 * m22 - m02 * m20, m01 * m20 - m00 * m21
    c20, c21, c22 = m01 * m12 - m02 * m11, m02 * m10 - m00 * m12, m00 * m11 - m01 * m10
    scale = 1.0 / (m00 * c00 + m01 * c01 + m02 * c02)
    return (
        (c00 * r0 + c10 * r1 + c20 * r2) * scale,
        (c01 * r0 + c11 * r1 + c21 * r2) * scale,
        (c02 * r0 + c12 * r1 + c22 * r2) * scale,
    )


@compiled
def gaps_declared(st: Array, sensors: Array) -> None:
    """Set the true height of the platform at each sensor."""
    for j in range(sensors.shape[1]):
        x, y = sensors[SENSOR_X, j], sensors[SENSOR_Y, j]
        sensors[GAP, j] = st[Q + 2] + y * st[Q] + x * st[Q + 1]


@compiled
def measure_declared(
    par: Array, st: Array, coils: Array, sensors: Array, noise: Array, out: Array
) -> None:
    """Write the readings; the drive force follows from the beam's motion (inverse dynamics)."""
    measure(par, coils, sensors, noise, out)
    at = sensors.shape[1] + coils.shape[1]
    out[at] = quantise(st[Q + 3], par[BEAM_LSB])
    out[at + 1] = st[V + 3]
    along = st[A + 3] - par[Z_B] * st[A + 1] + par[G] * st[Q + 1]
    out[at + 2] = par[M_B] * along - st[BEAM_FORCE]
    out[at + 3] = quantise(st[Q + 4], par[ROTOR_LSB])
    out[at + 4] = st[V + 4]
    out[at + 5] = par[J_ROTOR] * st[A + 4]


# --- level `nonlinear` ---


@compiled
def move_nonlinear(
    par: Array, st: Array, coils: Array, sensors: Array, noise: Array, i: int, n_steps: int
) -> bool:
    """Advance by internal step i, to accelerations and heights at its end; return if all finite."""
    step_nonlinear(par, st, coils, noise, i, n_steps)
    accelerations_nonlinear(par, st, coils)
    gaps_nonlinear(st, sensors)
    total = 0.0
    for j in range(A + 5):
        total += st[j]
    return math.isfinite(total)


@compiled
def step_nonlinear(par: Array, st: Array, coils: Array, noise: Array, i: int, n_steps: int) -> None:
    """Advance all five DOF and the currents by internal step i of n_steps (Runge-Kutta)."""
    draw_noise(par, coils, noise, i)
    drive(par, st, BEAM_DRIVE, BEAM_LOOP, BEAM_FROM, 3, par[BEAM_LSB], i / n_steps)
    drive(par, st, ROTOR_DRIVE, ROTOR_LOOP, ROTOR_FROM, 4, par[ROTOR_LSB], i / n_steps)
    h = par[STEP]
    now, x, dx, total = st[0:10], st[WORK : WORK + 10], st[A : A + 5], st[WORK + 10 : WORK + 20]
    for j in range(10):
        x[j], total[j] = now[j], 0.0
    for stage in range(4):
        lag = par[LAG_0] if stage == 0 else par[LAG_1] if stage == 3 else par[LAG_HALF]
        accelerate_nonlinear(par, st, coils, lag)
        weight = h / 6.0 if stage in (0, 3) else h / 3.0
        ahead = h if stage == 2 else 0.5 * h
        for j in range(5):
            speed = x[V + j]
            total[j] += weight * speed
            total[V + j] += weight * dx[j]
            x[j] = now[j] + ahead * speed
            x[V + j] = now[V + j] + ahead * dx[j]
    for j in range(10):
        now[j] += total[j]
    settle_currents(par, coils)


@compiled
def accelerations_nonlinear(par: Array, st: Array, coils: Array) -> None:
    """Set the accelerations at the end of a step."""
    for j in range(10):
        st[WORK + j] = st[Q + j]
    accelerate_nonlinear(par, st, coils, 1.0)


@compiled
def drive(
    par: Array, st: Array, at: int, loop: int, ref: int, dof: int, lsb: float, s: float
) -> None:
    """Close one drive's position loop for a step: PID on the encoder, mass feed-forward, limit."""
    p, v, a = hermite(st, ref, s, par[PERIOD])
    encoder = quantise(st[Q + dof], lsb)
    keep = par[at + DRIVE_FILTER]
    speed = (
        keep * st[loop + LOOP_SPEED] + (1.0 - keep) * (encoder - st[loop + LOOP_LAST]) / par[STEP]
    )
    st[loop + LOOP_SPEED], st[loop + LOOP_LAST] = speed, encoder
    integral = st[loop + LOOP_INTEGRAL] + par[at + DRIVE_KI] * par[STEP] * (p - encoder)
    force = par[at + DRIVE_MASS] * a + par[at + DRIVE_KP] * (p - encoder) + integral
    force += par[at + DRIVE_KD] * (v - speed)
    limit = par[at + DRIVE_LIMIT]
    if -limit < force < limit:
        st[loop + LOOP_INTEGRAL] = integral  # frozen at the limit, against wind-up
    st[loop + LOOP_FORCE] = min(max(force, -limit), limit)


@compiled
def accelerate_nonlinear(par: Array, st: Array, coils: Array, lag: float) -> None:
    """Set the five accelerations st[A:] at the positions and velocities in st[WORK:].

    `lag` is the share of the step's first lack of current that is left at this instant.
    """
    x, g = st[WORK : WORK + 10], par[G]
    sp, cp, sth, cth = math.sin(x[0]), math.cos(x[0]), math.sin(x[1]), math.cos(x[1])
    vertical = (sth, cth * sp, cth * cp)
    e_psi, e_theta = (1.0, 0.0, 0.0), (0.0, -cp, sp)
    w = (x[5], -cp * x[6], sp * x[6])
    w_bias = (0.0, sp * x[5] * x[6], cp * x[5] * x[6])  # w' where q'' is zero

    M, rhs = st[MATRIX : MATRIX + 25], st[A : A + 5]
    for j in range(25):
        M[j] = 0.0
    for j in range(3):
        for k in range(j + 1):
            M[5 * j + k] = st[MASS + 3 * j + k]
    for j in range(5):
        rhs[j] = 0.0

    # Platform. At phi = 0 the bar is along x: the J's include platform and bar.
    bar, m_p = par[J_ROTOR], par[M_P]
    ix, iy, iz, ixy = par[J_PSI], par[J_THETA] - bar, par[J_Z] - bar, -par[J_PSITHETA]
    com = (par[COM], par[COM + 1], par[COM + 2])
    momentum = (ix * w[0] + ixy * w[1], ixy * w[0] + iy * w[1], iz * w[2])
    bias = cross(w, momentum)
    weight = cross(com, vertical)
    torque = (
        bias[0] + ixy * w_bias[1] + m_p * g * weight[0],
        bias[1] + iy * w_bias[1] + m_p * g * weight[1],
        bias[2] + iz * w_bias[2] + m_p * g * weight[2],
    )
    force = cross(w, cross(w, com))
    rise = cross(w_bias, com)
    rhs[0] -= torque[0]
    rhs[1] -= dot(e_theta, torque)
    rhs[2] -= m_p * (dot(vertical, force) + dot(vertical, rise) + g)
    M[0] += ix
    M[5] += e_theta[1] * ixy
    M[6] += e_theta[1] * e_theta[1] * iy + e_theta[2] * e_theta[2] * iz
    M[10] += m_p * weight[0]
    M[11] += m_p * dot(e_theta, weight)
    M[12] += m_p

    # Beam and rotor as points: a bar of inertia J and imbalance s equals two masses at +-L along it
    # minus their sum on the axis, which the beam's mass already includes; L is arbitrary.
    L, s, xb, zr = 0.1, par[IMBALANCE], x[3], par[ROTOR_Z]
    heavy, light = 0.5 * (bar / L + s) / L, 0.5 * (bar / L - s) / L
    lx, ly, turn = L * math.cos(x[4]), L * math.sin(x[4]), x[9]
    still = (0.0, 0.0, 0.0)
    frame = (e_psi, e_theta, vertical, w, w_bias)
    _add_point(M, rhs, par[M_B], (xb, 0.0, par[Z_B]), still, x[8], 0.0, g, frame)
    _add_point(M, rhs, -bar / (L * L), (xb, 0.0, zr), still, x[8], 0.0, g, frame)
    _add_point(M, rhs, heavy, (xb + lx, ly, zr), (-ly, lx, 0.0), x[8], turn, g, frame)
    _add_point(M, rhs, light, (xb - lx, -ly, zr), (ly, -lx, 0.0), x[8], turn, g, frame)

    _add_outer_forces(par, st, coils, lag, sp, cp, sth, cth)
    for drive_at, loop, j in ((BEAM_DRIVE, BEAM_LOOP, 3), (ROTOR_DRIVE, ROTOR_LOOP, 4)):
        speed = x[5 + j]
        slow = par[drive_at + COULOMB_SPEED]
        friction = par[drive_at + COULOMB] / math.sqrt(speed * speed + slow * slow)
        rhs[j] += st[loop + LOOP_FORCE] - (friction + par[drive_at + VISCOUS]) * speed
    rhs[3] += st[BEAM_FORCE]
    _solve(M, rhs)


@compiled
def _add_point(
    M: Array, rhs: Array, m: float, p: Vector, arm: Vector, vb: float, turn: float, g: float,
    frame: tuple[Vector, Vector, Vector, Vector, Vector],
) -> None:  # fmt: skip
    """Add a point mass on the beam at p that rotates with d p / d phi = arm."""
    e_psi, e_theta, vertical, w, w_bias = frame
    speed = (vb + turn * arm[0], turn * arm[1], 0.0)
    own = (-turn * turn * arm[1], turn * turn * arm[0])  # towards the axis
    coriolis, spin, rise = cross(w, speed), cross(w, cross(w, p)), cross(w_bias, p)
    bias = (
        spin[0] + rise[0] + 2.0 * coriolis[0] + own[0] + g * vertical[0],
        spin[1] + rise[1] + 2.0 * coriolis[1] + own[1] + g * vertical[1],
        spin[2] + rise[2] + 2.0 * coriolis[2] + g * vertical[2],
    )
    partial = (cross(e_psi, p), cross(e_theta, p), vertical, (1.0, 0.0, 0.0), arm)
    for j in range(5):
        rhs[j] -= m * dot(partial[j], bias)
        for k in range(j + 1):
            M[5 * j + k] += m * dot(partial[j], partial[k])


@compiled
def _add_outer_forces(
    par: Array, st: Array, coils: Array, lag: float, sp: float, cp: float, sth: float, cth: float
) -> None:
    """Add rods, coils, air, end stops and the effects' wrench to the right-hand side."""
    x = st[WORK : WORK + 10]
    q0, q1, q2, v0, v1, v2 = x[0], x[1], x[2], x[5], x[6], x[7]
    f0 = st[WRENCH] - par[K] * q0 - par[K + 1] * q1 - par[K + 2] * q2 - par[CUBIC] * q0**3
    f1 = st[WRENCH + 1] - par[K + 3] * q0 - par[K + 4] * q1 - par[K + 5] * q2
    f1 -= par[CUBIC + 1] * q1**3
    f2 = st[WRENCH + 2] - par[K + 6] * q0 - par[K + 7] * q1 - par[K + 8] * q2
    f2 -= par[CUBIC + 2] * q2**3
    for c in range(coils.shape[1]):
        px, py, command = coils[COIL_X, c], coils[COIL_Y, c], coils[COMMAND, c]
        d0, d1 = py * cp * cth, px * cth - py * sp * sth
        height = q2 + px * sth + py * sp * cth
        nominal = command + (coils[CURRENT, c] - command) * lag + coils[NOISE, c]
        force = nominal * coils[COIL_GAIN, c] * (1.0 + par[SLOPE] * height) + coils[DELTA, c]
        force -= par[AIR_D] * (v2 + d0 * v0 + d1 * v1)
        f0, f1, f2 = f0 + d0 * force, f1 + d1 * force, f2 + force
    for k in range(STOPS, par.size, 2):
        px, py = par[k], par[k + 1]
        d0, d1 = py * cp * cth, px * cth - py * sp * sth
        force = stop_force(par, q2 + px * sth + py * sp * cth, v2 + d0 * v0 + d1 * v1)
        f0, f1, f2 = f0 + d0 * force, f1 + d1 * force, f2 + force
    st[A] += f0
    st[A + 1] += f1
    st[A + 2] += f2


@compiled
def _solve(M: Array, b: Array) -> None:
    """Solve the 5 x 5 symmetric system in place by Cholesky; M holds the lower triangle."""
    for j in range(5):
        for k in range(j + 1):
            total = M[5 * j + k]
            for i in range(k):
                total -= M[5 * j + i] * M[5 * k + i]
            M[5 * j + k] = math.sqrt(total) if j == k else total / M[5 * k + k]
    for j in range(5):
        for i in range(j):
            b[j] -= M[5 * j + i] * b[i]
        b[j] /= M[5 * j + j]
    for j in range(4, -1, -1):
        for i in range(j + 1, 5):
            b[j] -= M[5 * i + j] * b[i]
        b[j] /= M[5 * j + j]


@compiled
def gaps_nonlinear(st: Array, sensors: Array) -> None:
    """Set the true height of the platform's plane at each sensor."""
    across, along = math.tan(st[Q]) / math.cos(st[Q + 1]), math.tan(st[Q + 1])
    for j in range(sensors.shape[1]):
        x, y = sensors[SENSOR_X, j], sensors[SENSOR_Y, j]
        sensors[GAP, j] = st[Q + 2] + y * across + x * along


@compiled
def measure_nonlinear(
    par: Array, st: Array, coils: Array, sensors: Array, noise: Array, out: Array
) -> None:
    """Write the readings; the drives report their encoder, its filtered speed and their force."""
    measure(par, coils, sensors, noise, out)
    at = sensors.shape[1] + coils.shape[1]
    out[at] = quantise(st[Q + 3], par[BEAM_LSB])
    out[at + 1] = st[BEAM_LOOP + LOOP_SPEED]
    out[at + 2] = st[BEAM_LOOP + LOOP_FORCE]
    out[at + 3] = quantise(st[Q + 4], par[ROTOR_LSB])
    out[at + 4] = st[ROTOR_LOOP + LOOP_SPEED]
    out[at + 5] = st[ROTOR_LOOP + LOOP_FORCE]


# --- both levels ---


@compiled
def measure(par: Array, coils: Array, sensors: Array, noise: Array, out: Array) -> None:
    """Write the readings of sensors (noise, clip, converter) and amplifiers (current, noise).

    The last S values of `noise` are the sensors'.
    """
    n_sensors, n_coils = sensors.shape[1], coils.shape[1]
    first, lsb, top = noise.size - n_sensors, par[LSB], par[CODE_MAX]
    for j in range(n_sensors):
        reading = sensors[SENSOR_GAIN, j] * sensors[GAP, j] + sensors[SENSOR_OFFSET, j]
        reading += par[SENSOR_NOISE] * noise[first + j]
        out[j] = min(max(np.rint(reading / lsb), -top - 1.0), top) * lsb
    for c in range(n_coils):
        out[n_sensors + c] = coils[CURRENT, c] + coils[NOISE, c]


@compiled
def quantise(value: float, lsb: float) -> float:
    """Return `value` rounded to the encoder's grid, or unchanged for an lsb of 0."""
    steps: float = np.rint(value / lsb)
    return steps * lsb if lsb > 0.0 else value


@compiled
def stop_force(par: Array, h: float, speed: float) -> float:
    """Return the vertical force of an end stop on a point at height h; it is never a pull."""
    depth = abs(h) - par[STOP_TRAVEL]
    if depth <= 0.0:
        return 0.0
    inward = speed if h > 0.0 else -speed
    push: float = max(par[STOP_K] * depth + par[STOP_D] * inward, 0.0)
    return -push if h > 0.0 else push


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@compiled
def dot(a: Vector, b: Vector) -> float:
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
