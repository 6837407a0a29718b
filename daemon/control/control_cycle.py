"""Compute one control cycle, compiled: pose, PI, feed-forward, excitation, limits, log row."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...model.geometry import decoupling_matrix, shape_matrix
from .controller_memory import ROWS, checks_of, memory_shape
from .faults import Fault
from .feed_forward import feed_forward
from .flight_segment import Segment
from .following_check import check_following, size
from .following_limits import following_check
from .sensor_checks import SensorChecks, check_sensors, checks_size, jumped, note_command
from .states import State

Array = NDArray[np.float64]

_READING, _GAP = int(Fault.READING), int(Fault.GAP)
_COMPUTATION, _BEAM = int(Fault.COMPUTATION), int(Fault.BEAM)
_POSE_FAULT, _VELOCITY, _HEAT = int(Fault.POSE), int(Fault.VELOCITY), int(Fault.HEAT)
_AMPLIFIER, _DRIVE, _SENSOR = int(Fault.AMPLIFIER), int(Fault.DRIVE), int(Fault.SENSOR)
_FAULT_STATE, _SELF_TEST = int(State.FAULT), int(State.SELF_TEST)
BEAM_MARGIN_M = 0.002
"""Overshoot of the beam beyond its setpoint range that is not yet a fault."""
# The measured beam velocity may exceed the setpoint limit by this factor plus this velocity.
_BEAM_MARGIN, _BEAM_MARGIN_M_S = 1.5, 0.05
# A readback above this multiple of the coil limit is invalid and does not count as heat.
_MOST_CARRIED = 10.0

# Rows of the memory, see controller_memory.
_POSE, _INTEGRAL, _REST, _GOAL, _LAST, _MODE, _BEAM_FF, _REF, _FF, _TAU, _LOST = range(ROWS)


class Controller:
    """Control the platform with three SISO PI controllers, feed-forward, limits and anti-windup.

    Drivers write `gap_m`, `readback_n`, `beam`, `rotor` and send `coil_n`, `beam_ref`, `rotor_ref`.
    `step` computes the outputs from the inputs and writes the log row of the cycle.

    Args:
        rig: geometry, gains and limits.
        period_s: cycle period in s.
        memory: array of `memory_shape`, initially zero; it keeps the coil heat for the next
            controller.

    Raises:
        ConfigError: see feed_forward.
    """

    def __init__(self, rig: RigConfig, period_s: float, memory: Array | None = None) -> None:
        geometry, limits = rig.geometry, rig.limits
        coils, sensors = len(geometry.coil_x_m), len(geometry.sensors_x_m)
        self._inputs = np.zeros(sensors + coils + 6)
        self.gap_m, self.readback_n, self.beam, self.rotor = np.split(
            self._inputs, np.cumsum([sensors, coils, 3])
        )
        self._outputs = np.zeros(coils + 6)
        self.coil_n, self.beam_ref, self.rotor_ref = np.split(self._outputs, np.cumsum([coils, 3]))
        by_model = feed_forward(rig, period_s)
        law = (
            decoupling_matrix(geometry.sensors_x_m, geometry.sensors_y_m).ravel(),
            decoupling_matrix(geometry.coil_x_m, geometry.coil_y_m).ravel(),
            shape_matrix(geometry.coil_x_m, geometry.coil_y_m).ravel(),
            rig.control.kp,
            [ki * period_s for ki in rig.control.ki],
            by_model.numbers,
            [limits.coil_n, limits.coil_rate_n_s * period_s],
            [limits.gap_m, limits.beam_m + BEAM_MARGIN_M],
            # Limits that the rig does not set are infinite.
            [limits.total_n or math.inf, limits.tilt_rad or math.inf, limits.gap_m_s or math.inf],
            [_BEAM_MARGIN * limits.beam_velocity_m_s + _BEAM_MARGIN_M_S],
            [(limits.coil_rms_n or math.inf) ** 2, period_s / limits.coil_time_constant_s],
            [period_s],
        )
        self._law = np.concatenate([np.asarray(part, float) for part in law])
        self._memory = np.zeros(memory_shape(coils, sensors)) if memory is None else memory
        self._memory[:ROWS] = 0.0
        self.heat, _, self._before, follow, _ = np.split(
            self._memory[ROWS:].ravel(),
            np.cumsum([coils, 1, sensors + 1, size(coils)]),
        )
        """Mean square force (C,) in N^2 over limits.coil_time_constant_s."""
        self._following = following_check(rig, by_model, period_s, follow)
        self._sensors = SensorChecks(rig, period_s, checks_of(self._memory, sensors))
        self._coil_time_constant_s = limits.coil_time_constant_s
        self._before[:] = np.nan
        self._engaged = False
        self._arrays: tuple[Any, ...] = ()

    @property
    def pose(self) -> Array:
        """Pose (3,) of the last cycle in rad, rad, m; a view."""
        return self._memory[_POSE, :3]

    @property
    def engaged(self) -> bool:
        """Whether control is on."""
        return self._engaged

    def begin(self, segment: Segment) -> None:
        """Prepare for `segment`.

        Engaging starts from the current pose, landing from the current reference and feed-forward:
        the force does not jump. Only a segment that engages switches control on: after idling, a
        halt or a fault, any other segment stays at zero force.
        """
        memory = self._memory
        memory[_BEAM_FF, 0] = segment.beam_feedforward
        self._engaged = segment.in_control and (segment.engages or self._engaged)
        if segment.engages:
            memory[_REST] = memory[_POSE]
            memory[_INTEGRAL] = 0.0
            memory[_GOAL] = 0.0, 0.0, 0.0, 1.0
            memory[_BEAM_FF, 1] = segment.beam_feedforward
            self._sensors.engage()
        if segment.lands:
            memory[_GOAL] = memory[_LAST]
        memory[_MODE, :3] = segment.state, self._engaged, segment.airborne
        self._arrays = (
            segment.v, segment.coil_excitation, segment.blend, segment.beam, segment.rotor,
        )  # fmt: skip

    def follow(self, reads_back: bool) -> None:
        """Begin to check that coils and drives follow: their devices are open or recovered.

        reads_back: whether the amplifiers measure the force; see following_check.
        """
        self._following.begin(reads_back)

    def learn_rest(self, rows: NDArray[np.void]) -> str:
        """Learn the sensors' noise from cycle records (n,) at zero force; see SensorChecks.learn.

        The checks that need it, and those of the plane, begin anew.
        """
        return self._sensors.learn(rows)

    def latch(self, fault: Fault) -> None:
        """Log `fault` in every row until Fault.NONE is latched."""
        self._memory[_MODE, 3] = fault

    def detail(self, fault: Fault) -> str:
        """Return the reading that caused `fault` as text; empty if no reading did."""
        gap, heat = np.abs(self.gap_m), self.heat
        if fault is Fault.GAP:
            repeats = self._sensors.repeats(int(gap.argmax()))
            stood = f", which repeats its reading for {repeats} cycles" if repeats else ""
            return f"{1e3 * gap.max():.3f} mm at sensor {gap.argmax()}{stood}"
        if fault is Fault.POSE:
            return f"psi {1e3 * self.pose[0]:.3f} mrad, theta {1e3 * self.pose[1]:.3f} mrad"
        if fault is Fault.VELOCITY:
            return f"beam velocity {self.beam[1]:.3f} m/s, height {1e3 * self.pose[2]:.3f} mm"
        if fault is Fault.HEAT:
            return f"{heat.max() ** 0.5:.1f} N RMS in coil {heat.argmax()}"
        if fault is Fault.SENSOR:
            return self._sensors.text()
        return self._following.text(fault)

    def halt(self) -> None:
        """Switch control off: command zero force until a segment engages again."""
        self.coil_n[:] = 0.0
        self._memory[_INTEGRAL] = 0.0
        self._engaged = False
        self._memory[_MODE, 1] = 0.0

    def cool(self, seconds: float) -> None:
        """Cool the coils for `seconds` at zero force that were not computed as cycles."""
        self.heat *= math.exp(-max(seconds, 0.0) / self._coil_time_constant_s)

    def move(self, k: int) -> None:
        """Set only the manipulator setpoints of cycle `k`, as `step` would."""
        *_, beam, rotor = self._arrays
        self.beam_ref[:] = beam[min(k, len(beam) - 1)]
        self.rotor_ref[:] = rotor[min(k, len(rotor) - 1)]

    def step(
        self,
        rows: NDArray[np.void],
        slot: int,
        cycle: int,
        time_s: float,
        k: int,
        read_s: float = 0.0,
        stale: int = 0,
    ) -> int:
        """Compute cycle `k` of the segment and write row `slot`; return the fault, 0 for none.

        `read_s` is the delay from the cycle's nominal time to the last reading, in s. `stale` are
        the bits of the log field: which readings are of an earlier cycle.
        """
        return control_cycle(  # type: ignore[no-any-return]
            rows, slot, cycle, time_s, k, read_s, stale,
            self._inputs, self._outputs, self._law, self._memory, *self._arrays,
        )  # fmt: skip


@njit(cache=True)
def control_cycle(  # type: ignore[no-untyped-def] # noqa: PLR0912, PLR0915 - the cycle, in its order
    rows, slot, cycle, time_s, k, read_s, stale, inputs, outputs, law, memory,
    v_all, coil_excitation_all, blend_all, beam_all, rotor_all,
):  # fmt: skip
    """Compute one cycle; see Controller.step, and Controller for the packed arrays.

    Segment arrays have one row per cycle, or a single row for all cycles.
    """
    row = rows[slot]
    n_coils, n_sensors = outputs.size - 6, row.gap_m.size
    gap = inputs[:n_sensors]
    readback = inputs[n_sensors : n_sensors + n_coils]
    beam, rotor = inputs[-6:-3], inputs[-3:]
    coil, beam_ref, rotor_ref = outputs[:n_coils], outputs[-6:-3], outputs[-3:]

    end = 3 * n_sensors
    T_sensors = law[:end].reshape(3, n_sensors)
    T_coils = law[end : end + 3 * n_coils].reshape(3, n_coils)
    S_coils = law[end + 3 * n_coils : end + 6 * n_coils].reshape(n_coils, 3)
    kp, ki_Ts, by_model = law[-41:-38], law[-38:-35], law[-35:-14].reshape(3, 7)
    weight, beam_weight, rods, coil_limit, coil_step, gap_limit, beam_limit = law[-14:-7]
    total_limit, tilt_limit, speed_limit, beam_speed_limit, heat_limit, cooling, Ts = law[-7:]

    pose, integral, rest, goal, last = (
        memory[_POSE], memory[_INTEGRAL], memory[_REST], memory[_GOAL], memory[_LAST],
    )  # fmt: skip
    ref, ff, tau, lost = memory[_REF], memory[_FF], memory[_TAU], memory[_LOST]
    memory[_REF:ROWS] = 0.0
    more = memory[ROWS:].reshape(-1)
    heat, before = more[:n_coils], more[n_coils + 1 : n_coils + n_sensors + 2]
    deviates = check_following(
        coil, readback, beam[0], beam_ref[0], rotor[0], rotor_ref[0], stale,
        memory[_MODE, 3] == 0.0, more[n_coils + n_sensors + 2 :][: 8 * (n_coils + 3)],
    )  # fmt: skip
    state, in_control, airborne = memory[_MODE, 0], memory[_MODE, 1] > 0, memory[_MODE, 2] > 0

    v = v_all[min(k, len(v_all) - 1)]
    coil_excitation = coil_excitation_all[min(k, len(coil_excitation_all) - 1)]
    blend = blend_all[min(k, len(blend_all) - 1)]

    fault = 0
    for j in range(n_sensors):
        # During lift-off and landing the stops lie beyond the limit: apply ten times the limit.
        if abs(gap[j]) > gap_limit * (1.0 if airborne else 10.0) and in_control:
            fault = _GAP
    # If the loop stalled before reading, the gaps changed over these periods too.
    periods = cycle - before[n_sensors] + max(read_s / Ts - 1.0, 0.0)
    checks = more[more.size - checks_size(n_sensors) :]
    fresh, too_fast, most = False, False, speed_limit * Ts * periods
    for j in range(n_sensors):
        too_fast = too_fast or abs(gap[j] - before[j]) > most
        fresh = fresh or gap[j] != before[j]
    if too_fast and airborne and in_control:
        fault = _SENSOR if jumped(gap, before[:n_sensors], most, checks) else _VELOCITY
    for j in range(n_sensors):
        before[j] = gap[j]
    if fresh:  # stale gaps keep their cycle: the next change spans the whole time
        before[n_sensors] = cycle
    if in_control and abs(beam[1]) > beam_speed_limit:
        fault = _VELOCITY
    if in_control and abs(beam[0]) > beam_limit:
        fault = _BEAM
    # In periods without a step (skipped, or no readings), coils kept their last commanded force.
    missed = cycle - more[n_coils] - 1.0
    more[n_coils] = cycle
    if missed > 0.0:
        kept = math.exp(-cooling * missed)
        for j in range(n_coils):
            heat[j] = coil[j] * coil[j] + kept * (heat[j] - coil[j] * coil[j])
    for j in range(n_coils):
        # The readback may be stuck: the commanded force counts as well. The clip keeps an invalid
        # readback from raising the heat for good.
        measured = abs(readback[j]) if np.isfinite(readback[j]) else 0.0
        carried = min(max(measured, abs(coil[j])), _MOST_CARRIED * coil_limit)
        heat[j] += cooling * (carried * carried - heat[j])
        if heat[j] > heat_limit and in_control:
            fault = _HEAT
    for j in range(inputs.size):
        if not np.isfinite(inputs[j]):
            fault = _READING

    for i in range(3):
        pose[i] = 0.0
        for j in range(n_sensors):
            pose[i] += T_sensors[i, j] * gap[j]
    if (
        (abs(pose[0]) > tilt_limit or abs(pose[1]) > tilt_limit)
        and airborne and in_control and fault == 0
    ):  # fmt: skip
        fault = _POSE_FAULT
    # A coil that deviates explains why the platform leaves its range: even in its first reading.
    moved_off = fault in (_GAP, _VELOCITY, _POSE_FAULT)
    if 0 < abs(deviates) <= n_coils and (moved_off or (deviates > 0 and fault == 0)):
        fault = _AMPLIFIER
    elif deviates > n_coils and fault == 0:
        fault = _DRIVE
    # A sensor at fault explains why the platform seems to leave its range.
    judged = memory[_MODE, 3] == 0.0 and state != _SELF_TEST
    judged = judged and fault in (0, _GAP, _VELOCITY, _POSE_FAULT)
    if judged and check_sensors(gap, pose, stale, checks):
        fault = _SENSOR
    active = in_control and fault == 0
    carries_beam, carried_beam = memory[_BEAM_FF, 0], memory[_BEAM_FF, 1]
    if active:
        for i in range(3):
            ref[i] = rest[i] + blend[0] * (goal[i] - rest[i])
            last[i] = ref[i]
        last[3] = blend[1] * goal[3]
        # Bumpless: what the feed-forward no longer carries of a resting beam, the integrators do.
        taken_over = last[3] * (carried_beam - carries_beam) * beam[0]
        integral[1] += taken_over * beam_weight
        memory[_BEAM_FF, 1] = carries_beam
        ff[1] = last[3] * beam_weight * beam[0] * carries_beam
        ff[2] = last[3] * (weight + rods * ref[2])
        at = min(k, len(beam_all) - 1)
        for i in range(3):
            integral[i] += taken_over * by_model[i, 4]
            carried = by_model[i, 0] + carries_beam * by_model[i, 4] * beam[0]
            for j in range(3):
                carried += by_model[i, 1 + j] * ref[j]
            for j in range(1, 3):
                carried += carries_beam * by_model[i, 4 + j] * beam_all[at, j]
            if carried != 0.0:  # keep -0.0 in the log of a rig without a model
                ff[i] += last[3] * carried
            error = ref[i] - pose[i]
            integral[i] += ki_Ts[i] * error
            tau[i] = blend[2] * (kp[i] * error + integral[i] + ff[i] + v[i])

    saturated = 0
    for j in range(n_coils):
        force = 0.0
        if active:
            force = blend[2] * coil_excitation[j]
            for i in range(3):
                force += T_coils[i, j] * tau[i]
            if not np.isfinite(force):
                fault = _COMPUTATION
            low, high = max(-coil_limit, coil[j] - coil_step), min(coil_limit, coil[j] + coil_step)
            allowed = min(max(force, low), high)
            if allowed != force:
                saturated += 1
                for i in range(3):
                    lost[i] += S_coils[j, i] * (force - allowed)
            force = allowed
        coil[j] = force
    total = 0.0
    for j in range(n_coils):
        total += abs(coil[j])
    if total > total_limit:
        saturated = n_coils
        for j in range(n_coils):
            for i in range(3):
                lost[i] += S_coils[j, i] * coil[j] * (1.0 - total_limit / total)
            coil[j] *= total_limit / total
    if fault != 0:
        coil[:] = 0.0
        integral[:] = 0.0
    elif saturated:
        # Anti-windup: an integrator does not advance in a direction that the coils cannot follow.
        for i in range(3):
            increment = ki_Ts[i] * (ref[i] - pose[i])
            if increment * lost[i] > 0.0:
                integral[i] -= increment

    steady = active and airborne and beam_ref[1] == 0.0 and rotor_ref[1] == 0.0
    steady = steady and carries_beam == carried_beam
    note_command(coil, S_coils, ff, blend[2], steady, n_sensors, checks)

    for j in range(3):
        beam_ref[j] = beam_all[min(k, len(beam_all) - 1), j]
        rotor_ref[j] = rotor_all[min(k, len(rotor_all) - 1), j]

    row.cycle = cycle
    row.time_s = time_s
    for j in range(n_sensors):
        row.gap_m[j] = gap[j]
    row.psi_rad, row.theta_rad, row.z_m = pose[0], pose[1], pose[2]
    row.psi_ref_rad, row.theta_ref_rad, row.z_ref_m = ref[0], ref[1], ref[2]
    played = blend[2] if active else 0.0
    row.v_psi_n_m, row.v_theta_n_m, row.v_z_n = played * v[0], played * v[1], played * v[2]
    for j in range(n_coils):
        row.coil_excitation_n[j] = played * coil_excitation[j]
        row.coil_n[j] = coil[j]
        row.coil_readback_n[j] = readback[j]
    row.ff_psi_n_m, row.ff_theta_n_m, row.ff_z_n = played * ff[0], played * ff[1], played * ff[2]
    row.tau_psi_n_m, row.tau_theta_n_m, row.tau_z_n = tau[0], tau[1], tau[2]
    row.beam_m, row.beam_m_s, row.beam_force_n = beam[0], beam[1], beam[2]
    row.beam_ref_m, row.beam_ref_m_s, row.beam_ref_m_s2 = beam_ref[0], beam_ref[1], beam_ref[2]
    row.rotor_rad, row.rotor_rad_s, row.rotor_torque_n_m = rotor[0], rotor[1], rotor[2]
    row.rotor_ref_rad = rotor_ref[0]
    row.lateness_s = 0.0
    row.execution_s = 0.0
    row.state = _FAULT_STATE if fault != 0 else state
    row.fault = fault if fault != 0 else memory[_MODE, 3]
    row.saturated = min(saturated, 255)
    row.skipped = 0
    row.stale = stale
    return fault
