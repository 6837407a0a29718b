"""Test the effects that only plants other than the rig have, against their equations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from effect_test_helpers import rig_places
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.identify_greybox import to_yaml
from levid.identification.trace.records.record_from_log import imported_places
from levid.identification.trace.traced_model import model_effect
from levid.model.effects.base import Effect, Placed, Places, Signals
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.effect_serialization import placed_effects
from levid.model.effects.lag_and_hysteresis_recursions import lagged_mean, lagged_within
from levid.model.effects.operating_range import Extent

MODEL = """
levid: model
name: arm
dof: [{name: angle, unit: rad}]
inputs: [{name: voltage, unit: V}]
M: [[1.0]]
D: [[1.0]]
K: [[1.0]]
"""
TS, LAG_S, MIDDLE, COMMAND = 1e-3, 2e-3, 0.4, -3.0
FAMILIES = ("gravity.", "backlash.", "cogging.", "magnetic_force.", "actuator.")
KEYS = (
    "damping.drift",
    "stiffness.drift",
    "inertia.drift",
    "damping.warming",
    "friction.warming",
    "flexible_mode.load",
    "damping.asymmetric",
    "damping.falling",
    "damping.eddy_current",
    "damping.power",
    "damping.root",
    "stiffness.power",
    "stiffness.leveling_off",
    "stiffness.snap_through",
    "stiffness.exponential.up",
    "stiffness.exponential.down",
    "permanent_magnet.y2.opens",
    "permanent_magnet.y2.closes",
    "permanent_magnet.y4.opens",
    "permanent_magnet.y4.closes",
    "friction.coulomb_asymmetric",
    "friction.leveling_off",
    "friction.stribeck_asymmetric",
    "gravity.sine",
    "gravity.sine_for_stiffness",
    "stiffness.preloaded",
    "backlash.dead_zone_spring",
    "backlash.play",
    "backlash.load",
    "cogging.position",
    "cogging.position.another",
    *(f"magnetic_force.{law}.{way}" for law in ("i2_y2", "i1_y4", "i2_y4", "differential")
      for way in ("opens", "closes")),
    "actuator.square",
    "actuator.squared",
    "actuator.quadratic",
    "actuator.cubic",
    "actuator.root",
    "actuator.times_speed",
    "actuator.quantised",
    "actuator.hysteresis",
    "actuator.squared_after_lag",
    "actuator.quadratic_after_lag",
)  # fmt: skip
OF_PARTS = (
    "actuator.times_speed", "stiffness.preloaded", "damping.falling", "damping.eddy_current",
    "friction.leveling_off", "stiffness.leveling_off", "stiffness.snap_through", "damping.power",
    "damping.root",
)  # fmt: skip
"""Laws that are means of parts of a row."""
EACH = pytest.mark.parametrize("key", KEYS)
Law = Callable[..., np.ndarray]


def places() -> Places:
    return imported_places(parse_text(MODEL, ModelConfig, "arm"))


@cache
def moving(lag_s: float = 0.0) -> Signals:
    """Return six seconds of an arm around MIDDLE with commands around COMMAND."""
    t, rng = np.arange(6000) * TS, np.random.default_rng(2)
    w, phase = 2 * np.pi * rng.integers(2, 30, 6) / 6.0, rng.uniform(0, 2 * np.pi, 6)
    angle = np.multiply.outer(t, w) + phase
    q, qd, qdd = (
        0.1 * part.sum(axis=1)[:, None]
        for part in (np.sin(angle), w * np.cos(angle), -w * w * np.sin(angle))
    )
    coil = COMMAND + 0.8 * rng.standard_normal((len(t), 1))
    nothing = np.zeros(len(t))
    others = tuple(nothing for _ in range(6))
    return Signals(TS, t, q + MIDDLE, qd, qdd, coil, *others, 1, places(), lag_s, around_rows=True)


@cache
def table() -> dict[str, Effect]:
    found = all_effects(places(), Extent.measured([moving()]))
    return {e.key.partition("[")[0]: e for e in found if e.key.partition("[")[0] in KEYS}


def placed(key: str) -> Placed:
    """Return an effect with arbitrary amplitudes and a shape off the grid."""
    effect = table()[key]
    amplitudes = tuple(0.3 + 0.4 * i for i in range(len(effect.amplitudes)))
    return Placed(effect, tuple(1.07 * v for v in effect.grid[-1]), amplitudes)


def test_new_effects_are_only_in_tables_of_other_plants():
    new = set(KEYS)
    assert set(table()) == new
    rig = {e.key.partition("[")[0] for e in all_effects(rig_places())}
    of_both = {"friction.coulomb_asymmetric", "friction.stribeck_asymmetric"}
    assert rig & new == of_both
    assert [key for key in rig if key.startswith(FAMILIES)] == ["backlash.bearing"]


def test_gravity_needs_an_angle():
    in_metres = places()
    in_metres = Places(**{**vars(in_metres), "dof_units": ("m",)})
    assert "gravity.sine" not in {e.key for e in all_effects(in_metres)}
    in_degrees = Places(**{**vars(in_metres), "dof_units": ("deg",)})
    (gravity,) = (e for e in all_effects(in_degrees) if e.key == "gravity.sine")
    sine, cosine = (t.force for t in gravity.build(moving(), ()))
    np.testing.assert_allclose(sine**2 + cosine**2, 1.0)
    np.testing.assert_allclose(sine, -np.sin(moving().q * np.pi / 180))


# Equations, written again. Each returns the force on the DOF or the addition to the command.


def around_rows(law, motion=None):
    """Return what the means of a law of the speed (or of a motion, a function of time) around rows
    tell of it at the rows (N,)."""
    s = moving()
    if motion is None:
        motion = CubicHermiteSpline(s.time_s, s.qd[:, 0], s.qdd[:, 0])
    inside = (np.arange(100) + 0.5) / 100
    fine = law(motion(s.time_s[:-1, None] + TS * inside))
    before, behind = fine[:, :50].mean(axis=1), fine[:, 50:].mean(axis=1)
    means = 0.5 * (np.append(before, behind[-1]) + np.append(before[0], behind))
    # A wave's mean over a row is smaller than the wave.
    return means - np.diff(np.pad(means, 1, mode="edge"), 2) / 24.0


def sliding(q, v, F, friction, asymmetry, v_s):
    return -around_rows(lambda v: friction * np.tanh(v / v_s) + asymmetry * np.tanh(v / v_s) ** 2)


def stribeck(q, v, F, friction, peak, asymmetry, v_s, turn):
    def law(v):
        direction = np.tanh(v / (turn * v_s))
        level = friction + peak * np.exp(-((v / v_s) ** 2))
        return level * direction + asymmetry * direction**2

    return -around_rows(law)


def preloaded(q, v, F, P, q0, width):
    s = moving()
    position = CubicHermiteSpline(s.time_s, s.q[:, 0], s.qd[:, 0])
    return -P * around_rows(lambda q: np.clip((q - q0) / width, -1.0, 1.0), position)


def leveling_off(q, v, F, P, q0, width):
    s = moving()
    position = CubicHermiteSpline(s.time_s, s.q[:, 0], s.qd[:, 0])
    return -P * around_rows(lambda q: np.tanh((q - q0) / width), position)


def to_a_power(law: str, of_speed: bool) -> Law:
    def force(q, v, F, size, p):
        at = float(table()[law].key.partition("[")[2].rstrip("]"))

        def one(x):
            return -size * np.sign(x) * np.abs(x / at) ** p

        return around_rows(one) if of_speed else one(q)

    return force


def permanent_magnet(power: int, way: float) -> Law:
    def force(q, v, F, c, y0):
        y = q - float(table()["permanent_magnet.y2.opens"].key.partition("[")[2].rstrip("]"))
        return c * ((y0 / (y0 + way * y)) ** power - 1.0)

    return force


def dead_zone_spring(q, v, F, k, q0, half):
    above, below = np.maximum(q - q0 - half, 0.0), np.minimum(q - q0 + half, 0.0)
    return -k * (above + below)


def play(q, v, F, k, half):
    """Return the force of a part that is dragged along; it has been moved before the record."""
    output, p = [], q[0]
    for x in [*q[:4000], *q]:
        p = x - half if x - p > half else x + half if x - p < -half else p
        output.append(p)
    return -k * (q - np.array(output[4000:]))


def hysteresis(q, v, F, *numbers):
    """Return what play operators of three widths leave of a command that came before the record."""
    *shares, r = numbers
    ratios = (1.0, 3.0, 9.0)
    return sum(play(F, v, F, s, ratio * r) for s, ratio in zip(shares, ratios, strict=True))


def load(q, v, F, m, frequency, damping, half, slowing):
    """Return the force of a load behind a gap, on a path of cubic splines."""
    path, w = CubicHermiteSpline(np.arange(len(q)) * TS, q, v), 2 * np.pi * frequency

    def contact(t, there, rate):
        x, stretched = there - path(t), there - path(t) - np.clip(there - path(t), -half, half)
        return w**2 * stretched + 2 * damping * w * (rate - path(t, 1)) * (abs(x) > half)

    def motion(t, state):
        return state[1], -contact(t, *state) - slowing * state[1]

    times = np.arange(len(q)) * TS
    begin = (q[0] - slowing * v[0] / w**2, v[0]) if half == 0.0 else (q[0], v[0])
    run = solve_ivp(motion, (0.0, times[-1]), begin, t_eval=times, max_step=TS / 4)
    return m * contact(times, *run.y)


def cogging(q, v, F, a, b, pitch):
    size, shift = np.hypot(a, b), np.arctan2(b, a)
    return size * np.sin(2 * np.pi * q / pitch + shift)


def held_around(F):
    """Return the commands that act before and after each row, a row later."""
    after = np.concatenate([F[:1], F[:-1]])
    return np.concatenate([F[:1], after[:-1]]), after


def magnet(current: int, gap: int, way: float) -> Law:
    def full(i, y, c, y0, i0):
        # The mean command is negative: a more negative command is a larger current.
        return c * ((i0 - i) / i0) ** current * (y0 / (y0 + way * y)) ** gap

    return beyond_linear(full)


def two_magnets(way: float) -> Law:
    def full(i, y, c, y0, i0):
        first, second = ((i0 + s * i) / i0 * y0 / (y0 + s * way * y) for s in (1.0, -1.0))
        return c / 4.0 * (first**2 - second**2)

    return beyond_linear(full)


def beyond_linear(force) -> Law:
    def law(q, v, F, *values):
        at_q, at_F = working_point("magnetic_force.i2_y2.opens")

        def full(q, F):
            return force(F - at_F, q - at_q, *values)

        h = 1e-5
        by_q = (full(at_q + h, at_F) - full(at_q - h, at_F)) / (2 * h)
        by_F = (full(at_q, at_F + h) - full(at_q, at_F - h)) / (2 * h)
        # Each command is held for a period: a row has the mean of those before and after it.
        acts = 0.5 * sum(full(q, held) - by_F * (held - at_F) for held in held_around(F))
        return acts - full(at_q, at_F) - by_q * (q - at_q)

    return law


def working_point(key: str) -> tuple[float, float]:
    q, F = table()[key].key.partition("[")[2].rstrip("]").split(",")
    return float(q), float(F)


def mean_command(key: str) -> float:
    return float(table()[key].key.partition("[")[2].rstrip("]"))


def times_speed(q, v, F, a):
    # Commanded in a row, it acts from the next row to the one after that.
    later = np.minimum(np.arange(len(v)) + 1, len(v) - 1)
    last = np.minimum(later + 1, len(v) - 1)
    return a * F * (v[later] + v[last]) / 2


def load_on_shaft(q, v, F, m, frequency, damping, slowing):
    return load(q, v, F, m, frequency, damping, 0.0, slowing)


def warming(q, v, F, friction, excess, v_s, tau):
    def law(t):
        speed = CubicHermiteSpline(moving().time_s, moving().qd[:, 0], moving().qdd[:, 0])(t)
        return (friction + excess * np.exp(-t / tau)) * np.tanh(speed / v_s)

    return -around_rows(law, lambda t: t)


LAWS: dict[str, Law] = {
    "damping.drift": lambda q, v, F, rate: -rate * moving().time_s * v,
    "stiffness.drift": lambda q, v, F, rate: -rate * moving().time_s * q,
    "inertia.drift": lambda q, v, F, rate: -rate * moving().time_s * moving().qdd[:, 0],
    "damping.warming": lambda q, v, F, excess, tau: -excess * np.exp(-moving().time_s / tau) * v,
    "friction.warming": warming,
    "flexible_mode.load": load_on_shaft,
    "damping.eddy_current": lambda q, v, F, d, v_0: (
        -d * around_rows(lambda v: v / (1.0 + (v / v_0) ** 2))
    ),
    "damping.falling": lambda q, v, F, d, v_0: (
        -d * around_rows(lambda v: v * v_0 / (v_0 + np.abs(v)))
    ),
    "damping.asymmetric": lambda q, v, F, asymmetry: -asymmetry * np.sign(v) * v,
    "friction.coulomb_asymmetric": sliding,
    "friction.leveling_off": lambda q, v, F, friction, v_0: (
        -friction * around_rows(lambda v: v / (v_0 + np.abs(v)))
    ),
    "friction.stribeck_asymmetric": stribeck,
    "gravity.sine": lambda q, v, F, k_s, k_c: -(k_s * np.sin(q) + k_c * np.cos(q)),
    "gravity.sine_for_stiffness": lambda q, v, F, k_s, k_c, k: (
        k * q - k_s * np.sin(q) - k_c * np.cos(q)
    ),
    "stiffness.preloaded": preloaded,
    "stiffness.leveling_off": leveling_off,
    "stiffness.snap_through": lambda *numbers: -leveling_off(*numbers),
    "stiffness.exponential.up": lambda q, v, F, P, d: -P * (np.exp(q / d) - 1.0),
    "stiffness.exponential.down": lambda q, v, F, P, d: P * (np.exp(-q / d) - 1.0),
    "stiffness.power": to_a_power("stiffness.power", False),
    "damping.power": to_a_power("damping.power", True),
    "damping.root": to_a_power("damping.root", True),
    **{
        f"permanent_magnet.y{power}.{way}": permanent_magnet(power, sign)
        for power in (2, 4)
        for way, sign in (("opens", 1.0), ("closes", -1.0))
    },
    "actuator.root": lambda q, v, F, a: a * np.sign(F) * np.sqrt(np.abs(F)),
    "backlash.dead_zone_spring": dead_zone_spring,
    "backlash.play": play,
    "backlash.load": load,
    "cogging.position": cogging,
    "cogging.position.another": cogging,
    **{
        f"magnetic_force.i{a}_y{b}.{way}": magnet(a, b, sign)
        for a, b in ((2, 2), (1, 4), (2, 4))
        for way, sign in (("opens", 1.0), ("closes", -1.0))
    },
    "magnetic_force.differential.opens": two_magnets(1.0),
    "magnetic_force.differential.closes": two_magnets(-1.0),
    "actuator.square": lambda q, v, F, depth: (
        depth * (F * np.abs(F) / mean_command("actuator.square") - F)
    ),
    "actuator.squared": lambda q, v, F, a: a * np.sign(F) * F**2,
    "actuator.quadratic": lambda q, v, F, a: a * (F - mean_command("actuator.quadratic")) ** 2,
    "actuator.cubic": lambda q, v, F, a: a * F**3,
    "actuator.times_speed": times_speed,
    "actuator.quantised": lambda q, v, F, depth, step: (
        depth * (np.floor(F / step + 0.5) * step - F)
    ),
    "actuator.hysteresis": hysteresis,
    "actuator.squared_after_lag": lambda q, v, F, a: a * np.sign(F) * F**2,  # of a model without
    "actuator.quadratic_after_lag": lambda q, v, F, a: (
        a * (F - mean_command("actuator.quadratic_after_lag")) ** 2
    ),
}


@EACH
def test_term_is_the_equation_along_a_trajectory(key: str):
    s, effect = moving(), placed(key)
    term = effect.term(s)
    found = term.held if key.startswith("actuator.") else term.force
    others = [p for p in term.parts if p is not None and p is not found]
    assert not others
    assert found is not None
    expected = LAWS[key](s.q[:, 0], s.qd[:, 0], s.coil[:, 0], *effect.amplitudes, *effect.shape)
    assert expected.std() > 0.0
    if key == "backlash.load":
        # The force jumps where it hits an edge, and a bounce comes otherwise after the last one
        # came a little otherwise.
        assert np.linalg.norm(found[:, 0] - expected) < 0.05 * np.linalg.norm(expected)
        return
    if key in OF_PARTS or key.startswith("friction."):
        # In a quarter of a row the speed is linear, and a Stribeck peak is that in its middle. A
        # held command has the product's mean and moment, the reference its mean.
        np.testing.assert_allclose(found[:, 0], expected, atol=2e-3 * np.abs(expected).max())
        return
    # The reference of the magnets differentiates numerically.
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-6 * np.abs(expected).max())


@EACH
def test_terms_and_their_derivatives_by_the_shape_are_finite_on_the_grid(key: str):
    effect = table()[key]
    for row in effect.grid:
        for i, quantity in enumerate(effect.shape):
            step = 1e-4 * row[i] if quantity.log else 1e-6 * (quantity.high - quantity.low)
            ends = []
            for sign in (1.0, -1.0):
                there = list(row)
                there[i] += sign * step
                ends.append(
                    [p for t in effect.build(moving(), there) for p in t.parts if p is not None]
                )
            for one, other in zip(*ends, strict=True):
                assert np.all(np.isfinite((one - other) / (2 * step))), (key, row, quantity.name)
        for term in effect.build(moving(), row):
            (part,) = (p for p in term.parts if p is not None)
            assert np.any(part), (key, row)


@EACH
def test_effect_is_read_back_from_a_model_file_with_other_records(key: str):
    written = placed(key)
    config = parse_text(MODEL, ModelConfig, "arm").model_copy(
        update={"effects": (model_effect(written),)}
    )
    read = parse_text(to_yaml(config), ModelConfig, "arm")
    other = Extent((0.01,), (0.2,), 0.01, 5.0, 0.0, middle=(-7.0,), commands=((9.0, 1.0),))
    for extent in (None, other):
        (back,) = placed_effects(read.effects, places(), extent)
        assert back.effect.identity == written.effect.identity
        assert (back.shape, back.amplitudes) == (written.shape, written.amplitudes)
        for one, two in zip(back.term(moving()).parts, written.term(moving()).parts, strict=True):
            assert (one is None) == (two is None)
            assert one is None or np.array_equal(one, two)


@pytest.mark.parametrize("law", ["squared", "quadratic"])
def test_a_square_after_the_lag_is_a_command_that_becomes_the_square_by_the_lag(law: str):
    lag_s = 0.03
    t = np.arange(3000) * TS
    F = 1.0 + 2.0 * np.sin(2 * np.pi * 1.3 * t) + 0.5 * np.sin(2 * np.pi * 7.1 * t)
    s = replace(moving(lag_s), coil=F[:, None], time_s=t)
    added = Placed(table()[f"actuator.{law}_after_lag"], (), (0.7,)).term(s).held[:, 0]
    acts = lagged_within(added, lag_s, TS, 1.0)
    speed = lagged_within(F, lag_s, TS, 1.0)
    middle = mean_command("actuator.quadratic_after_lag")
    square = 0.7 * (speed * np.abs(speed) if law == "squared" else (speed - middle) ** 2)
    # The begin is forgotten after seven times the lag; held values of 1 ms know the rest to 1e-5.
    np.testing.assert_allclose(acts[300:], square[300:], atol=1e-4 * np.abs(square).max())


def test_friction_of_two_levels_has_these_levels():
    s = moving()
    effect = table()["friction.coulomb_asymmetric"]
    force = Placed(effect, (1e-4,), (0.5, 0.2)).term(s).force[:, 0]
    v = s.qd[:, 0]
    # Rows beside a reversal have a part of each.
    away = np.convolve(np.abs(v) < 0.2, np.ones(5), "same") == 0.0
    np.testing.assert_allclose(force[away & (v > 0.0)], -0.7)
    np.testing.assert_allclose(force[away & (v < 0.0)], 0.3)


def test_a_reversal_within_a_row_gives_the_mean_force_of_its_two_sides():
    s = moving()
    extent = Extent((0.1,), (1.0,), 0.1, 5.0, 0.0)
    effect = {e.key: e for e in all_effects(places(), extent)}["friction.coulomb"]
    force = Placed(effect, (1e-9,), (1.0,)).term(s).force[:, 0]
    expected = -around_rows(np.sign)
    reverses = np.convolve(s.qd[1:, 0] * s.qd[:-1, 0] < 0.0, np.ones(2)) > 0.0
    # The reference knows the moment to a hundredth of a row.
    np.testing.assert_allclose(force[reverses], expected[reverses], atol=0.03)
    assert np.abs(force[reverses]).min() < 0.5


def test_inputs_of_other_units_have_limits_of_their_own_size():
    extent = Extent((1.0,), (1.0,), 1.0, 12.0, 0.0, largest=(0.2, 12.0))
    assert extent.largest_command((0,)) == 0.2
    assert extent.largest_command((0, 1)) == 12.0
    assert Extent((1.0,), (1.0,), 1.0, 5.0, 0.0).largest_command((0,)) == 5.0


def test_a_mass_on_a_spring_is_searched_below_the_highest_frequency():
    slow = Extent((1.0,), (1.0,), 1.0, 5.0, 0.0, spans_s=((0.0, 60.0),), fastest_hz=1.5)
    found = {e.key: e for e in all_effects(places(), slow)}["flexible_mode.loose_mass"]
    starts = np.array([f for f, _ in found.grid])
    assert found.shape[0].low <= 1.0 / 60.0
    assert starts.max() < 1.5
    assert starts.min() < 0.1
    # An octave of a resonance with the damping ratio that fits start from is wider than this.
    assert np.max(starts[:-1] / starts[1:]) < 1.3


def test_an_input_moves_as_the_dof_that_it_pushes():
    text = MODEL.replace(
        "dof: [{name: angle, unit: rad}]",
        "dof: [{name: motor, unit: rad}, {name: twist, unit: rad}]",
    )
    two = "[[1.0, 0.0], [0.0, 1.0]]"
    text = text.replace("[[1.0]]", two) + "B: [[0.0], [-3.0]]\n"
    few = imported_places(parse_text(text, ModelConfig, "arm"))
    np.testing.assert_allclose(few.actuator_motion, [[0.0, 1.0]])
    keys = {e.key for e in all_effects(few, Extent((1.0,) * 2, (1.0,) * 2, 1.0, 5.0, 0.0))}
    assert {"actuator.times_speed", "force_constant.linear"} <= keys


@pytest.mark.parametrize("way", ["opens", "closes"])
def test_magnetic_force_is_quadratic_near_its_working_point(way: str):
    """Stiffness and gain of the model keep their meaning: there the effect has neither."""
    key = f"magnetic_force.i2_y2.{way}"
    effect, (at_q, at_F) = table()[key], working_point(key)
    s, sizes = moving(), []
    for size in (1e-3, 1e-4):
        near = Signals(**{
            **vars(s), "q": at_q + size * (s.q - at_q), "coil": at_F + size * (s.coil - at_F),
        })  # fmt: skip
        sizes.append(np.abs(effect.build(near, effect.grid[0])[0].force).max())
    assert sizes[1] == pytest.approx(1e-2 * sizes[0], rel=0.02)


def test_magnetic_force_follows_the_lagged_current():
    s = moving(LAG_S)
    effect = table()["magnetic_force.i1_y4.opens"]
    late = Signals(
        **{**vars(s), "lag_s": 0.0, "coil": lagged_mean(s.coil[:, 0], LAG_S, TS)[:, None]}
    )
    shape = effect.grid[0]
    np.testing.assert_allclose(effect.build(s, shape)[0].force, effect.build(late, shape)[0].force)


def test_unknown_contact_force_of_a_play_decays_as_the_play_is_passed():
    effect, s = table()["backlash.play"], moving()
    assert effect.initial_force_decay is not None
    half = 0.2
    decay = effect.initial_force_decay(s, (half,))[0].force[:, 0]
    assert decay[0] == 1.0
    assert np.all(np.diff(decay) <= 1e-12)
    passed = np.flatnonzero(np.abs(s.q[:, 0] - s.q[0, 0]) > 2 * half)[0]
    assert np.all(decay[passed:] < 1e-12)


def test_pitches_are_dense_enough():
    travel = 0.5
    extent = Extent((travel / 4,), (1.0,), 0.1, 5.0, 0.0, periods=((0.013, 0.07),))
    (effect,) = (e for e in all_effects(places(), extent) if e.key == "cogging.position")
    pitches = np.sort([pitch for (pitch,) in effect.grid])
    assert len(pitches) <= 60
    over = np.sort(travel / pitches[pitches >= 0.999 * travel / 20])
    np.testing.assert_allclose(over[[0, -1]], [2.0, 20.0])
    assert np.diff(over).max() <= 0.5 + 1e-9
    # Shorter ones are lines of the force over the position.
    assert pitches[pitches < 0.999 * travel / 20].tolist() == [0.013]


@pytest.mark.parametrize(
    ("key", "amplitudes", "lacks"),
    [
        ("friction.coulomb_asymmetric", (0.0, 1.0), True),  # pushes in one direction
        ("friction.coulomb_asymmetric", (0.1, 1.0), False),
        ("friction.stribeck_asymmetric", (0.0, 1.0, 0.0), True),
        ("backlash.dead_zone_spring", (0.0,), False),  # has no other force than that of the gap
    ],
)
def test_a_law_without_the_force_that_it_is_named_after(
    key: str, amplitudes: tuple[float, ...], lacks: bool
) -> None:
    effect = table()[key]
    assert Placed(effect, effect.grid[0], amplitudes).lacks_its_own_force == lacks
