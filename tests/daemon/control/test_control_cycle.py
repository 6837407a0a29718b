"""Test control law, limits and faults of the cycle against the equations in numpy."""

from dataclasses import replace

import numpy as np
import pytest

from levid.config.rig import RigConfig, load_rig
from levid.config.shipped import shipped
from levid.daemon.control.control_cycle import Controller
from levid.daemon.control.faults import Fault
from levid.daemon.control.flight_segment import Segment, idle_segment
from levid.daemon.control.states import State
from levid.log.signals import cycle_dtype
from levid.model.geometry import decoupling_matrix, shape_matrix

RIG = load_rig(shipped("rigs/loopback.yaml"))
PERIOD = 1e-3
X, Y = RIG.geometry.coil_x_m, RIG.geometry.coil_y_m
T = decoupling_matrix(X, Y)
WEIGHT = 7.0 * 9.81


def flying(cycles: int, **more: object) -> Segment:
    zero = np.zeros((1, 3))
    segment = Segment(
        State.EXCITING, cycles, zero, np.zeros((1, 9)), np.ones((1, 3)), zero, zero, engages=True
    )
    return replace(segment, **more)


class Bench:
    def __init__(self, rig: RigConfig = RIG) -> None:
        self.control = Controller(rig, PERIOD)
        self.rows = np.zeros(5000, cycle_dtype(9, 9))
        self.cycle = 0

    def run(self, segment: Segment, gaps: np.ndarray, read_s: float = 0.0) -> np.ndarray:
        """Fly the segment on these gap readings (n, 9), there so late; return its rows."""
        first = self.cycle
        self.control.begin(segment)
        for k, gap in enumerate(gaps):
            self.control.gap_m[:] = gap
            time_s = self.cycle * PERIOD
            fault = self.control.step(self.rows, self.cycle, self.cycle, time_s, k, read_s)
            self.cycle += 1
            if fault:
                break
        return self.rows[first : self.cycle]


def test_law_is_pi_with_feed_forward_and_excitation() -> None:
    n = 200
    rng = np.random.default_rng(1)
    q = rng.normal(0, 1e-5, (n, 3))
    v = rng.normal(0, [0.1, 0.1, 1.3], (n, 3))
    coil_excitation = rng.normal(0, 0.1, (n, 9))
    bench = Bench()
    bench.control.beam[0] = 0.05
    rows = bench.run(flying(n, v=v, coil_excitation=coil_excitation), q @ shape_matrix(X, Y).T)

    error = -q  # the reference is zero: engaging starts from the first pose, at rest it is zero
    kp, ki = np.array(RIG.control.kp), np.array(RIG.control.ki)
    tau = kp * error + np.cumsum(ki * PERIOD * error, axis=0) + v
    tau += [0.0, 1.4 * 9.81 * 0.05, WEIGHT]
    logged = np.stack([rows[name] for name in ("tau_psi_n_m", "tau_theta_n_m", "tau_z_n")], axis=1)
    # float32 of the log: 6e-8 of 70 N.
    np.testing.assert_allclose(logged, tau, atol=5e-6)
    np.testing.assert_allclose(rows["coil_n"], tau @ T + coil_excitation, atol=2e-6)
    np.testing.assert_allclose(rows["z_m"], q[:, 2], atol=1e-11)


def test_engaging_starts_without_a_jump() -> None:
    # At the stops, control begins where the platform lies: zero force in the first cycle.
    bench = Bench()
    rest = np.full((1, 9), -0.0009)
    bench.run(idle_segment(1, 9, np.zeros(3), np.zeros(3)), rest)
    blend = np.array([[0.0, 0.0, 1.0]])
    rows = bench.run(flying(1, blend=blend, airborne=False), rest)
    assert np.all(rows["coil_n"] == 0.0)


def test_landing_starts_from_the_reference_and_feed_forward_at_hand() -> None:
    bench = Bench()
    rest = np.full((1, 9), -0.0009)
    bench.run(idle_segment(1, 9, np.zeros(3), np.zeros(3)), rest)
    half_way = np.array([[0.5, 0.6, 1.0]])
    up = bench.run(flying(1, blend=half_way, airborne=False), rest)
    down = bench.run(
        flying(1, blend=np.ones((1, 3)), airborne=False, engages=False, lands=True), rest
    )
    assert down["z_ref_m"][0] == up["z_ref_m"][0]
    assert down["ff_z_n"][0] == up["ff_z_n"][0]


def test_the_integrators_take_over_the_weight_of_a_beam_and_give_it_back() -> None:
    bench = Bench()
    level, at_rest = np.zeros((20, 9)), np.array([[0.05, 0.0, 0.0]])
    flown = []
    for carries, x_m in ((True, 0.05), (False, 0.05), (False, -0.03), (True, -0.03)):
        bench.control.beam[0] = x_m
        segment = flying(20, beam=at_rest, engages=not flown, beam_feedforward=carries)
        flown.append(bench.run(segment, level))
    torque = 1.4 * 9.81 * 0.05
    # Without a control error the torque stays what it was with the beam at 50 mm.
    for rows in flown:
        np.testing.assert_allclose(rows["tau_theta_n_m"], torque, rtol=1e-6)
    for rows, carried in zip(flown, (torque, 0.0, 0.0, -0.6 * torque), strict=True):
        np.testing.assert_allclose(rows["ff_theta_n_m"], carried, rtol=1e-6)
        np.testing.assert_allclose(rows["ff_z_n"], WEIGHT, rtol=1e-6)


def test_a_braking_beam_is_carried_from_the_first_cycle_of_a_landing_on() -> None:
    # Its reaction m_b z_b a is a force that acts now: the integrators must not cancel it.
    bench, level = Bench(), np.zeros((1, 9))
    moving = np.array([[0.0, 0.2, 2.0]])
    bench.run(flying(1, beam=moving, beam_feedforward=False), level)
    rows = bench.run(flying(1, beam=moving, engages=False, lands=True), level)
    assert abs(rows["ff_theta_n_m"][0]) > 0.15
    np.testing.assert_allclose(rows["tau_theta_n_m"], rows["ff_theta_n_m"], rtol=1e-6)


@pytest.mark.parametrize("lands", [True, False])
def test_nothing_but_engaging_brings_control_in(lands: bool) -> None:
    bench = Bench()
    level = np.zeros((1, 9))
    bench.run(flying(1), level)
    bench.run(idle_segment(1, 9, np.zeros(3), np.zeros(3)), level)
    rows = bench.run(flying(1, engages=False, lands=lands), level)
    assert np.all(rows["coil_n"] == 0.0)
    bench.run(flying(1), level)
    bench.control.halt()
    rows = bench.run(flying(1, engages=False, lands=lands), level)
    assert np.all(rows["coil_n"] == 0.0)


def test_coil_force_and_its_rate_are_clipped_and_counted() -> None:
    rig, v = limited(total_n=None), np.array([[0.0, 0.0, 1000.0]])
    rows = Bench(rig).run(flying(3, v=v), np.zeros((3, 9)))
    assert np.all(rows["coil_n"] == 20.0)  # limits.coil_n, within a step of 40 N
    assert np.all(rows["saturated"] == 9)
    rows = Bench(limited(total_n=None, coil_rate_n_s=1000.0)).run(flying(3, v=v), np.zeros((3, 9)))
    np.testing.assert_allclose(rows["coil_n"][:, 0], [1.0, 2.0, 3.0], rtol=1e-6)


def test_integrator_does_not_wind_up_while_coils_are_at_their_limit() -> None:
    def recovery(n_saturated: int) -> np.ndarray:
        bench = Bench()
        push = np.array([[0.0, 0.0, 1000.0]])
        down, level = np.full((n_saturated, 9), -1e-4), np.zeros((1, 9))
        bench.run(flying(n_saturated, v=push), down)
        return bench.run(flying(1, engages=False), level)["tau_z_n"]

    # The error asks for more than the coils give: however long, the integrator stays.
    np.testing.assert_array_equal(recovery(10), recovery(2000))


@pytest.mark.parametrize("where", ["gap_m", "readback_n", "beam", "rotor"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_reading_that_is_no_number_gives_zero_force(where: str, value: float) -> None:
    bench = Bench()
    bench.control.begin(flying(2))
    assert bench.control.step(bench.rows, 0, 0, 0.0, 0) == Fault.NONE
    assert np.all(bench.control.coil_n != 0.0)
    getattr(bench.control, where)[1] = value
    assert bench.control.step(bench.rows, 1, 1, PERIOD, 1) == Fault.READING
    assert np.all(bench.control.coil_n == 0.0)
    assert bench.rows["state"][1] == State.FAULT
    assert bench.rows["fault"][1] == Fault.READING
    assert np.all(bench.rows["coil_n"][1] == 0.0)


def test_leaving_the_flying_range_is_a_fault_in_flight_alone() -> None:
    outside = np.zeros((1, 9))
    outside[0, 4] = RIG.limits.gap_m * 1.01
    assert Bench().run(flying(1), outside)["fault"][0] == Fault.GAP
    assert Bench().run(flying(1, airborne=False), outside)["fault"][0] == Fault.NONE


def test_excitation_that_is_no_number_is_a_fault() -> None:
    rows = Bench().run(flying(1, v=np.full((1, 3), np.nan)), np.zeros((1, 9)))
    assert rows["fault"][0] == Fault.COMPUTATION
    assert np.all(rows["coil_n"] == 0.0)


def test_latched_fault_stands_in_every_row_until_cleared() -> None:
    bench = Bench()
    idle = idle_segment(1, 9, np.zeros(3), np.zeros(3))
    bench.control.latch(Fault.GAP)
    assert bench.run(idle, np.zeros((1, 9)))["fault"][0] == Fault.GAP
    bench.control.latch(Fault.NONE)
    assert bench.run(idle, np.zeros((1, 9)))["fault"][0] == Fault.NONE


def limited(**limits: float | None) -> RigConfig:
    return RIG.model_copy(update={"limits": RIG.limits.model_copy(update=limits)})


def test_sum_of_all_coils_is_scaled_down_and_counted() -> None:
    v = np.array([[0.5, 0.0, 60.0]])
    free = Bench().run(flying(1, v=v), np.zeros((1, 9)))["coil_n"][0]
    rows = Bench(limited(total_n=90.0)).run(flying(1, v=v), np.zeros((1, 9)))
    # Every coil by the same factor: the wrench keeps its direction. float32 of the log.
    np.testing.assert_allclose(rows["coil_n"][0], free * 90.0 / np.abs(free).sum(), rtol=1e-6)
    assert rows["saturated"][0] == 9
    plain = Bench(limited(total_n=200.0)).run(flying(1, v=v), np.zeros((1, 9)))
    np.testing.assert_array_equal(plain["coil_n"][0], free)


@pytest.mark.parametrize("axis", [0, 1])
def test_tilt_beyond_its_limit_is_a_fault_in_flight_alone(axis: int) -> None:
    rig, q = limited(tilt_rad=1e-3), np.zeros(3)
    for tilt, fault in ((0.9e-3, Fault.NONE), (-1.1e-3, Fault.POSE)):
        q[axis] = tilt
        gap = (shape_matrix(X, Y) @ q)[None, :]
        assert Bench(rig).run(flying(1), gap)["fault"][0] == fault
        assert Bench(rig).run(flying(1, airborne=False), gap)["fault"][0] == Fault.NONE


@pytest.mark.parametrize(
    ("skipped", "read_s", "fault"),
    [
        (0, 0.0, Fault.VELOCITY),
        (0, 0.9 * PERIOD, Fault.VELOCITY),
        (1, 0.0, Fault.NONE),
        # It stood still behind its begin, before or after the reading was taken: nobody knows.
        (0, 1.5 * PERIOD, Fault.NONE),
    ],
)
def test_speed_is_judged_by_the_time_that_passed(skipped: int, read_s: float, fault: Fault) -> None:
    bench = Bench(limited(gap_m_s=0.15))
    level = np.zeros((1, 9))
    bench.run(flying(1), level)
    bench.cycle += skipped
    moved = level + 0.2e-3  # 0.2 m/s over one period, 0.1 m/s over two
    rows = bench.run(flying(1, engages=False), moved, read_s)
    assert rows["fault"][0] == fault


def test_beam_that_runs_away_is_a_fault() -> None:
    bench = Bench()
    bench.control.beam[1] = 2 * RIG.limits.beam_velocity_m_s
    assert bench.run(flying(1), np.zeros((1, 9)))["fault"][0] == Fault.VELOCITY
    assert bench.control.detail(Fault.VELOCITY).startswith("beam velocity 1.000 m/s")


def test_coil_that_carries_too_much_for_too_long_is_a_fault() -> None:
    bench = Bench(limited(coil_rms_n=5.0, coil_time_constant_s=1.0))
    bench.control.readback_n[3] = 10.0
    rows = bench.run(flying(1000), np.zeros((1000, 9)))
    # 100 (1 - e^-t) reaches 25 after 0.288 s; the discrete lag is off by half a period.
    assert rows["time_s"][-1] == pytest.approx(-np.log(0.75), abs=1.5e-3)
    assert rows["fault"][-1] == Fault.HEAT
    assert bench.control.detail(Fault.HEAT).endswith("in coil 3")
    # At rest it cools down, and no fault is made of it.
    bench.control.readback_n[3] = 0.0
    idle = idle_segment(2000, 9, np.zeros(3), np.zeros(3))
    assert bench.run(idle, np.zeros((2000, 9)))["fault"].max() == Fault.NONE
    assert bench.run(flying(1), np.zeros((1, 9)))["fault"][0] == Fault.NONE


def test_coil_whose_readback_is_stuck_is_as_hot_as_it_was_told_to_be() -> None:
    bench = Bench(limited(coil_rms_n=5.0, coil_time_constant_s=0.1))
    bench.control.readback_n[:] = 0.0
    pushed = np.zeros((1, 9))
    pushed[0, 4] = 10.0
    rows = bench.run(flying(1000, coil_excitation=pushed), np.zeros((1000, 9)))
    assert rows["fault"][-1] == Fault.HEAT
    assert bench.control.detail(Fault.HEAT).endswith("in coil 4")


def test_readback_that_no_coil_can_carry_is_forgotten_as_any_other() -> None:
    """Squared it would overflow, and a heat that is not a number exceeds no limit ever again."""
    bench = Bench(limited(coil_rms_n=5.0, coil_time_constant_s=1.0))
    bench.control.readback_n[3] = 1e200
    # It counts as ten times the limit of 20 N, in one cycle of a thousandth: 40 of 25 N^2.
    assert bench.run(flying(1), np.zeros((1, 9)))["fault"][0] == Fault.HEAT
    bench.control.readback_n[3] = 0.0
    bench.run(idle_segment(1000, 9, np.zeros(3), np.zeros(3)), np.zeros((1000, 9)))
    assert bench.run(flying(1), np.zeros((1, 9)))["fault"][0] == Fault.NONE  # 40/e
    bench.control.readback_n[3] = 10.0
    assert bench.run(flying(1000), np.zeros((1000, 9)))["fault"][-1] == Fault.HEAT


def test_coils_cool_down_in_cycles_that_were_not_computed() -> None:
    """Readings that fail, and devices that are opened, left them as hot as they were, for hours."""
    rig = limited(coil_rms_n=8.0, coil_time_constant_s=10.0)
    bench = Bench(rig)
    bench.control.readback_n[:] = 7.0
    bench.run(flying(5000), np.zeros((5000, 9)))
    hot = bench.control.heat.copy()
    bench.control.halt()
    bench.control.readback_n[:] = 0.0
    bench.control.begin(idle_segment(1, 9, np.zeros(3), np.zeros(3)))
    bench.control.step(bench.rows, 0, bench.cycle + 9_999, 0.0, 0)
    np.testing.assert_allclose(bench.control.heat, hot * np.exp(-1.0), rtol=1e-3)
    bench.control.cool(20.0)
    np.testing.assert_allclose(bench.control.heat, hot * np.exp(-3.0), rtol=1e-3)


def test_coils_carry_on_in_periods_that_are_skipped() -> None:
    bench = Bench(limited(coil_rms_n=40.0, coil_time_constant_s=1.0))
    bench.run(flying(100), np.zeros((100, 9)))
    told = bench.control.coil_n.copy()
    assert told.min() > 5.0
    bench.control.step(bench.rows, 0, bench.cycle + 30_000, 0.0, 0)
    np.testing.assert_allclose(bench.control.heat, told**2, rtol=1e-3)


def test_coil_that_says_nothing_cools_down_as_it_was_told() -> None:
    bench = Bench(limited(coil_rms_n=8.0, coil_time_constant_s=1.0))
    bench.run(flying(500), np.zeros((500, 9)))
    hot = bench.control.heat.copy()
    bench.control.halt()
    bench.control.readback_n[:] = np.nan
    for cycle in range(500, 1500):
        bench.control.step(bench.rows, cycle, cycle, cycle * PERIOD, 0)
    np.testing.assert_allclose(bench.control.heat, hot * np.exp(-1.0), rtol=1e-2)
