"""Test free-form effects: dependence on signals, and round trip through a model file."""

from __future__ import annotations

import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from effect_test_helpers import acts, moving, rig_places
from numpy.polynomial import chebyshev
from scipy.signal import lsim

from levid.model.effects.freeform import DEGREE, Form, depends_on, freeform_effect, freeform_effects
from levid.model.effects.operating_range import Extent


def effects():
    return freeform_effects(rig_places(), Extent.typical(rig_places()))


def test_key_and_location_define_a_form():
    for effect in effects():
        again = freeform_effect(rig_places(), effect.key, effect.where)
        assert again is not None
        assert again.identity == effect.identity
        shape, s = effect.grid[0], moving()
        for ours, theirs in zip(effect.build(s, shape), again.build(s, shape), strict=True):
            np.testing.assert_array_equal(acts(ours), acts(theirs))


def test_forms_have_unique_names_and_can_be_pickled():
    identities = [e.identity for e in effects()]
    assert len(set(identities)) == len(identities)
    pickle.loads(pickle.dumps(effects()))


def test_form_acts_at_its_location_only():
    for effect in effects():
        kind, _, number = effect.where[0].partition(":")
        for term in effect.build(moving(), effect.grid[0]):
            assert (term.gap is not None) == (kind == "sensor")
            assert (term.held is not None) == (kind == "coil")
            if kind == "coil":
                alone = rig_places().coil_shape[int(number)]
                along = acts(term) @ alone / (alone @ alone)
                np.testing.assert_allclose(acts(term), along[:, None] * alone, atol=1e-12)
                continue
            own = [int(number) if kind == "sensor" else rig_places().dof.index(kind)]
            if effect.key.startswith("unknown.wave") and kind == "z":
                own.append(1)  # a force at the beam's position
            assert not np.any(np.delete(acts(term), own, axis=1))


def test_only_forms_of_coils_and_sensors_depend_on_commands():
    by = {e.identity: e for e in effects() if any(w.startswith("coil") for w in depends_on(e))}
    kinds = {e.where[0].partition(":")[0] for e in by.values()}
    assert kinds == {"sensor", "coil"}
    stray = by["unknown.coil_3[12]@sensor:0"]
    assert depends_on(stray) == ("coil:3",)
    assert stray.name == "Reading that depends on the command of coil:3 at sensor 0"
    s = moving()
    # The field acts together with the coil force, one cycle after the command.
    columns = np.stack([acts(t)[:, 0] for t in stray.build(s, ())], axis=1)
    acting = s.acting(s.coil)[:, 3]
    residual = acting**2 - columns @ np.linalg.lstsq(columns, acting**2, rcond=None)[0]
    assert np.abs(residual).max() < 1e-9
    shared = by["unknown.coil_5[12]*coil_4[12]@coil:5"]
    assert depends_on(shared) == ("coil:5", "coil:4")
    product = s.coil[:, 5] * (s.coil[:, 4] / 7.0 - 1.0)
    alone = rig_places().coil_shape[5]
    columns = np.stack([acts(t) @ alone / (alone @ alone) for t in shared.build(s, ())], axis=1)
    residual = product - columns @ np.linalg.lstsq(columns, product, rcond=None)[0]
    assert np.abs(residual).max() < 1e-9
    # The key is invalid at another coil or at a DOF.
    assert freeform_effect(rig_places(), shared.key, ("coil:6",)) is None
    assert freeform_effect(rig_places(), stray.key, ("theta",)) is None


@pytest.mark.parametrize("by", ["x_b", "time", "z", "z_rate", "phi"])
def test_functions_of_a_form_do_not_contain_a_constant(by: str):
    """Each record already has a constant force as an unknown; readings have a separate constant."""
    s = np.linspace(-1.0, 1.0, 400) * (np.pi if by == "phi" else 1.0)
    functions = Form(by, 1.0)._shapes(s, DEGREE)
    best, *_ = np.linalg.lstsq(functions, np.ones(400), rcond=None)
    # The residual of a constant: all of it for harmonics, one spline segment for splines.
    assert np.mean((1.0 - functions @ best) ** 2) > 1e-3


def test_signal_times_a_function_is_nothing_where_the_other_signal_is_zero():
    """Else it would be a stiffness there, and the model's own would be wrong: 1 % of one."""
    form = freeform_effect(rig_places(), "unknown.psi[0.001]*theta[0.002]", ("psi",))
    assert form is not None
    s = moving()
    s = replace(s, q=s.q * np.array([1.0, 0.0, 1.0]))
    for term in form.build(s, ()):
        np.testing.assert_allclose(acts(term), 0.0, atol=1e-15)


def test_coil_form_can_represent_a_step_over_the_command():
    """For example, an amplifier with a second stage that has another offset."""
    s = moving()
    s = replace(s, coil=6.0 + s.coil)
    extent = Extent.measured([s])
    (own,) = (
        e for e in freeform_effects(s.places, extent) if e.where == ("coil:3",) and "+-" in e.key
    )
    again = freeform_effect(s.places, own.key, own.where)
    assert again is not None
    assert own.identity == again.identity
    alone = s.places.coil_shape[3]
    columns = np.stack([acts(t) @ alone / (alone @ alone) for t in again.build(s, ())], axis=1)
    step = 0.1 * (s.coil[:, 3] > 7.0)
    residual = (
        step
        - step.mean()
        - (columns - columns.mean(axis=0))
        @ np.linalg.lstsq(columns - columns.mean(axis=0), step - step.mean(), rcond=None)[0]
    )
    # A cubic polynomial leaves 40 %; twelve segments over six standard deviations less than 15 %.
    assert np.var(residual) < 0.15 * np.var(step)
    polynomials = chebyshev.chebvander((s.coil[:, 3] - 6.0) / 3.0, 3)
    cubic_residual = step - polynomials @ np.linalg.lstsq(polynomials, step, rcond=None)[0]
    assert np.var(cubic_residual) > 0.3 * np.var(step)


def test_sensor_form_can_represent_a_local_error():
    """For example, near a passing magnet. Sensor forms include an offset."""
    s = replace(moving(), x_b_m=np.linspace(-0.1, 0.1, 200))
    effect = freeform_effect(rig_places(), "unknown.x_b[0.1]", ("sensor:4",))
    assert effect is not None
    columns = np.stack([acts(t)[:, 4] for t in effect.build(s, ())], axis=1)
    bump = np.exp(-(((s.x_b_m - 0.01) / 0.03) ** 2))
    residual = bump - columns @ np.linalg.lstsq(columns, bump, rcond=None)[0]
    assert np.abs(residual).max() < 0.02  # cubic segments of 22 mm
    assert len(columns.T) == len(effect.amplitudes) == 12


@pytest.mark.parametrize(
    ("by", "signals"), [("v_b", ("v_b",)), ("a_b_v_b", ("a_b", "v_b")), ("phi_speed", ("phi'",))]
)
def test_leaky_integral_is_a_first_order_lag(by: str, signals: tuple[str, ...]):
    """For example, a capacitor that braking charges, or heating by friction."""
    s, tau_s = moving(), 0.4
    (effect,) = (e for e in effects() if e.where == ("sensor:2",) and f".lingering.{by}[" in e.key)
    assert depends_on(effect) == signals
    u = {"v_b": s.v_b_m_s, "a_b_v_b": s.a_b_m_s2 * s.v_b_m_s, "phi_speed": s.phi_rad_s}[by]
    scale = float(effect.key.partition("[")[2].rstrip("]"))
    for term, side in zip(effect.build(s, (tau_s,)), (u, -u), strict=True):
        lag_input = np.maximum(side, 0.0) / scale
        _, held, _ = lsim(
            ([1.0], [tau_s, 1.0]), lag_input - lag_input[0], s.Ts_s * np.arange(len(lag_input))
        )
        np.testing.assert_allclose(acts(term)[:, 2], lag_input[0] + held, atol=1e-9)


def test_lingering_forms_of_commands_are_relative_to_the_mean_and_for_sensors_only():
    s = moving()
    s = replace(s, coil=6.0 + s.coil)
    found = [
        e for e in freeform_effects(s.places, Extent.measured([s])) if ".lingering.coil" in e.key
    ]
    assert len(found) == 81
    assert {e.where[0].partition(":")[0] for e in found} == {"sensor"}
    warm = next(e for e in found if e.where == ("sensor:4",) and ".coil_7[" in e.key)
    assert depends_on(warm) == ("coil:7",)
    again = freeform_effect(s.places, warm.key, warm.where)
    assert again is not None
    above, below = (acts(t)[:, 4] for t in again.build(s, (1e-6,)))
    middle, scale = (float(n) for n in warm.key.partition("[")[2].rstrip("]").split("+-"))
    acting = s.acting(s.coil)[:, 7]
    np.testing.assert_allclose(middle + scale * (above - below), acting, atol=1e-3)
    assert freeform_effect(s.places, warm.key, ("theta",)) is None


@pytest.mark.parametrize(
    "key",
    [
        "v_b[0]", "v_b[-1]", "v_b[inf]", "v_b[1e999]", "v_b[1..2]", "v_b", "x_b[0.1]",
        "v_b[0.1+-0.4]", "coil_3[2]", "coil_9[6+-2]", "coil_3[nan+-2]", "coil_3[1e999+-2]",
    ],
)  # fmt: skip
def test_lingering_form_with_an_invalid_key_is_rejected(key: str):
    assert freeform_effect(rig_places(), f"unknown.lingering.{key}", ("sensor:1",)) is None
    assert freeform_effect(rig_places(), "unknown.lingering.v_b[0.4]", ("coil:1",)) is None


def test_fine_sensor_form_can_represent_a_narrow_part_of_the_range():
    """For example, sensor oscillators that lock to each other at nearly equal gaps."""
    s = moving()
    s = replace(s, q=np.linspace(-3e-3, 3e-3, len(s.q))[:, None] * np.ones(3))
    effect = freeform_effect(rig_places(), "unknown.psi[0+-0.003]~", ("sensor:4",))
    assert effect is not None
    columns = np.stack([acts(t)[:, 4] for t in effect.build(s, ())], axis=1)
    assert len(columns.T) == len(effect.amplitudes) == 20
    off, width = s.q[:, 0] - 4e-4, 3e-4
    lock = off - np.sign(off) * np.sqrt(np.maximum(off**2 - width**2, 0.0))
    residual = lock - columns @ np.linalg.lstsq(columns, lock, rcond=None)[0]
    polynomials = chebyshev.chebvander(s.q[:, 0] / 3e-3, 6)
    smooth = lock - polynomials @ np.linalg.lstsq(polynomials, lock, rcond=None)[0]
    # A polynomial cannot represent it. Cubic segments of 0.35 mrad leave its two edges.
    assert np.var(residual) < 0.25 * np.var(smooth)


@pytest.mark.parametrize("key", ["unknown.z_rate[1]*phi", "unknown.z[1]*phi", "unknown.phi"])
@pytest.mark.parametrize("where", ["z", "sensor:4"])
def test_form_from_a_key_has_one_amplitude_per_term(key: str, where: str):
    effect = freeform_effect(rig_places(), key, (where,))
    assert effect is not None
    assert len(effect.build(moving(), ())) == len(effect.amplitudes)


def test_functions_of_the_beam_position_are_local():
    form = Form("x_b", 0.1)
    ends = replace(moving(), x_b_m=np.linspace(-0.1, 0.1, 200))
    first_end, last_end = (
        form.functions(ends, constant=False)[rows] for rows in (slice(80), slice(-80, None))
    )
    assert not np.any(np.any(first_end != 0.0, axis=0)[-3:])
    assert not np.any(np.any(last_end != 0.0, axis=0)[:3])


def test_invalid_keys_give_no_effect():
    keys = ("unknown.nobody[1]", "unknown.theta", "unknown.theta[x]", "unknown.theta[0]")
    assert Form.of("unknown.theta[1]~") is Form.of("unknown.coil_1[0+-1]~") is None
    for key in (*keys, "friction.coulomb", "unknown.phi[1]", "unknown.z[1]*nobody[2]"):
        assert freeform_effect(rig_places(), key, ("theta",)) is None
    for nowhere in (("beam",), ("sensor:9",), ("psi", "z"), ()):
        assert freeform_effect(rig_places(), "unknown.x_b[0.1]", nowhere) is None


def test_resonant_response_equals_that_of_a_mass_on_a_spring():
    """Mass, damping and stiffness between the two DOF are excluded; the model has them."""
    Ts_s, rows, w, zeta, m = 1e-3, 8000, 2 * np.pi * 14.0, 0.05, 0.2
    t = np.arange(rows) * Ts_s
    f_hz = np.array([3.0, 7.0, 11.0, 13.5, 15.0, 22.0])[:, None]
    s = 2j * np.pi * f_hz
    waves = np.exp(s * t) * np.exp(1j * np.arange(6))[:, None]
    h, rate, twice = ((1e-4 * s**k * waves).sum(axis=0).imag for k in range(3))
    # The transfer function of a mass on a spring and damper, without a simulation.
    transfer = -m * s**2 * (w**2 + 2 * zeta * w * s) / (s**2 + 2 * zeta * w * s + w**2)
    force = (1e-4 * transfer * waves).sum(axis=0).imag
    q = np.stack([h, 0 * h, 0 * h], axis=1)
    signals = replace(moving(), Ts_s=Ts_s, time_s=t, q=q)
    effect = freeform_effect(rig_places(), "unknown.answer.psi", ("z",))
    assert effect is not None
    assert depends_on(effect) == ("psi",)
    settled = slice(4000, None)  # exp(-zeta w 4 s) is 2e-8

    def residual(frequency_hz: float) -> float:
        terms = effect.build(signals, (frequency_hz, zeta))
        columns = np.stack([h, rate, twice, *(term.force[:, 2] for term in terms)], axis=1)
        columns /= np.linalg.norm(columns, axis=0)
        best, *_ = np.linalg.lstsq(columns[settled], force[settled])
        return float(np.std((force - columns @ best)[settled]) / np.std(force[settled]))

    # Linear interpolation of inputs: (w Ts)^2 / 12 of a response five to ten times the motion.
    assert residual(14.0) < 0.01
    assert residual(20.0) > 0.2


def test_time_of_a_form_is_independent_of_the_session_span():
    # The simulator and `levid identify` use a model without the records of the trace.
    session, alone = rig_places((200.0, 300.0)), rig_places((0.0, 1.0))
    effect = next(
        e
        for e in freeform_effects(session, Extent.typical(session))
        if e.where == ("z",) and depends_on(e) == ("time",)
    )
    assert effect.key == "unknown.time[250+-50]"
    again = freeform_effect(alone, effect.key, effect.where)
    s = moving()
    late = replace(s, time_s=np.linspace(200.0, 300.0, s.rows))
    for ours, theirs in zip(
        effect.build(replace(late, places=session), ()),
        again.build(replace(late, places=alone), ()),
        strict=True,
    ):
        np.testing.assert_array_equal(acts(ours), acts(theirs))
        assert np.ptp(acts(ours)) > 0


def test_functions_cover_the_range_of_the_motion():
    # The beam moves on one side, and the platform is off its centre.
    places = rig_places()
    s = moving()
    there = np.linspace(0.0, 0.2, s.rows)
    q = s.q + np.array([0.0, 0.0, 0.05])
    covered = Extent.measured([replace(s, x_b_m=there, q=q)])
    found = {e.identity: e for e in freeform_effects(places, covered)}
    by_beam = found["unknown.x_b[0.1+-0.1]@z"]
    columns = [acts(t) for t in by_beam.build(replace(s, x_b_m=there), ())]
    # Each spline covers a part of the travel.
    assert all(np.ptp(column) > 0.1 for column in columns)
    (by_z,) = (
        e
        for e in found.values()
        if e.where == ("z",) and e.key.startswith("unknown.z[") and "*" not in e.key
    )
    form = Form.of(by_z.key)
    assert form is not None
    assert form.middle == pytest.approx(0.05, abs=0.2 * form.scale)  # the motion is not symmetric
    again = freeform_effect(places, by_z.key, by_z.where)
    for ours, theirs in zip(by_z.build(s, ()), again.build(s, ()), strict=True):
        np.testing.assert_array_equal(acts(ours), acts(theirs))


def test_hysteresis_of_a_coil_depends_on_reversals():
    """The force at equal commands differs between increasing and decreasing commands."""
    s = moving()
    t = np.arange(200) / 100
    command = 7.6 + 2.0 * np.sin(2 * np.pi * t)
    s = replace(s, coil=np.tile(command[:, None], 9))
    extent = replace(Extent.typical(rig_places()), commands=((7.6, 1.41),) * 9)
    (effect,) = [
        e
        for e in freeform_effects(rig_places(), extent)
        if e.key == "unknown.hysteresis.command[1.41]" and e.where == ("coil:6",)
    ]
    assert depends_on(effect) == ("coil:6",)
    terms = effect.build(s, ())
    for term, width in zip(terms, (0.05, 0.15, 0.4, 1.0, 2.5), strict=True):
        own = term.held @ np.linalg.pinv(np.atleast_2d(s.places.coil_shape[6]))
        held, r = [], 1.41 * width
        for start in (1.0, -1.0):  # the definition of a stop operator
            f, path = start, [start]
            for a, b in pairwise(command):
                f = min(max(f + (b - a) / r, -1.0), 1.0)
                path.append(f)
            held.append(path)
        np.testing.assert_allclose(own[:, 0], np.mean(held, axis=0), atol=1e-12)
    up, down = terms[1].held[110], terms[1].held[140]  # equal commands before and after a reversal
    assert np.abs(up - down).max() > np.abs(up).max()
    assert len(effect.initial_force_decay(s, ())) == len(terms)
    assert freeform_effect(rig_places(), "unknown.hysteresis.command[0]", ("coil:6",)) is None
    assert freeform_effect(rig_places(), "unknown.hysteresis.command[1]", ("z",)) is None
