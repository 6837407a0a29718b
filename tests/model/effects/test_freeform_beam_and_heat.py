"""Test free forms over beam travel and coil heat against explicit equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_test_helpers import acts, moving, rig_places
from scipy.signal import lsim

from levid.model.effects.base import Loads
from levid.model.effects.freeform import depends_on, freeform_effect, freeform_effects
from levid.model.effects.operating_range import Extent


def swept(hz_s: float = 0.02):
    """Return signals of a beam that oscillates over 0.2 m at increasing frequency."""
    t = 0.01 * np.arange(2000)
    angle = 2 * np.pi * (0.2 * t + 0.5 * hz_s * t**2)
    rate = 2 * np.pi * (0.2 + hz_s * t)
    s = moving()
    q = np.zeros((len(t), 3))
    return replace(
        s, time_s=t, q=q, qd=q, qdd=q, x_b_m=0.1 * np.sin(angle),
        v_b_m_s=0.1 * rate * np.cos(angle),
        a_b_m_s2=0.1 * (2 * np.pi * hz_s * np.cos(angle) - rate**2 * np.sin(angle)),
        coil=np.zeros((len(t), 9)),
    )  # fmt: skip


def explained(columns, wanted):
    columns = np.stack(columns, axis=1)
    residual = wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return 1.0 - np.linalg.norm(residual) / np.linalg.norm(wanted)


def test_wave_forms_represent_the_lift_by_an_uneven_rail():
    """m w'' with w = A cos(2 pi x_b / p + f) has a part in v_b^2 and a part in a_b."""
    s, period = swept(), 0.02
    dt = 1e-6

    def height(along_s: float):
        x = s.x_b_m + along_s * s.v_b_m_s + 0.5 * along_s**2 * s.a_b_m_s2
        return np.cos(2 * np.pi * x / period + 0.7)

    lift = (height(dt) - 2 * height(0.0) + height(-dt)) / dt**2
    parts = [
        freeform_effect(rig_places(), f"unknown.wave.{by}", ("z",)).build(s, (period,))
        for by in ("v_b_squared[0.16]", "a_b[4]")
    ]
    of_z = [acts(t)[:, 2] for terms in parts for t in terms]
    of_theta = [acts(t)[:, 1] for terms in parts for t in terms]
    assert explained(of_z, lift) > 0.999
    np.testing.assert_allclose(of_theta, s.x_b_m * of_z)
    assert explained(of_z[:2], lift) > 0.9  # at high speed a_b / (k v_b^2) is 1/20


@pytest.mark.parametrize(
    ("key", "where", "signals"),
    [
        ("v_b_squared[0.16]", "z", ("v_b", "x_b")),
        ("a_b[4]", "psi", ("a_b", "x_b")),
        ("v_b[0.4]", "sensor:3", ("v_b", "x_b")),
        ("place", "sensor:3", ("x_b",)),
    ],
)
def test_wave_form_depends_on_its_signals(key: str, where: str, signals: tuple[str, ...]):
    effect = freeform_effect(rig_places(), f"unknown.wave.{key}", (where,))
    assert depends_on(effect) == signals
    s = swept()
    factor = {"v": s.v_b_m_s ** len(signals), "a": s.a_b_m_s2, "p": 1.0}[key[0]]
    if key.startswith("v_b["):
        factor = s.v_b_m_s
    elif key.startswith("v_b_squared"):
        factor = s.v_b_m_s**2
    unit = float(key.partition("[")[2].rstrip("]") or 1.0)
    at = {"psi": 0, "z": 2, "sensor:3": 3}[where]
    cosine, sine = (acts(t)[:, at] for t in effect.build(s, (0.05,)))
    np.testing.assert_allclose(cosine, factor / unit * np.cos(2 * np.pi * s.x_b_m / 0.05))
    np.testing.assert_allclose(sine, factor / unit * np.sin(2 * np.pi * s.x_b_m / 0.05))


def test_warming_form_follows_the_coil_losses_through_a_session():
    """The heat at the start of a record agrees with a simulation of the whole session."""
    rng, Ts_s, tau_s, before_s = np.random.default_rng(3), 0.01, 11.0, 4.0
    coil_n = np.repeat(6.0 + rng.standard_normal(30), 200)  # 2 s each, the block length of loads
    t = Ts_s * np.arange(len(coil_n))
    loads = Loads(
        tuple(2.0 * np.arange(30)), tuple((*[0.0] * 7, float(f**2), 0.0) for f in coil_n[::200])
    )
    long_t = np.concatenate([np.arange(-before_s, 0.0, Ts_s), t])
    squares = np.concatenate([np.full(round(before_s / Ts_s), coil_n[0] ** 2), coil_n**2])
    _, heat, _ = lsim(([1.0], [tau_s, 1.0]), squares, long_t + before_s, interp=False)
    heat = heat[-len(t) :]
    rows = slice(2000, 6000)
    coil = np.zeros((4000, 9))
    coil[:, 7] = coil_n[rows]
    places = replace(rig_places(), loads=loads)
    s = replace(moving(), time_s=t[rows], coil=coil, places=places)
    effect = freeform_effect(rig_places(), "unknown.warming.coil_7", ("sensor:4",))
    assert depends_on(effect) == ("coil:7",)
    constant, warm = (acts(term)[:, 4] for term in effect.build(s, (tau_s, before_s)))
    np.testing.assert_array_equal(constant, 1.0)
    np.testing.assert_allclose(warm, heat[rows], rtol=1e-3)  # blocks of 2 s, steps of 10 ms


def test_number_of_wave_and_warming_forms_with_and_without_a_beam():
    places = rig_places()
    found = [e for e in freeform_effects(places, Extent.typical(places)) if "wave" in e.key]
    assert len(found) == 3 * (3 + 9) + 9
    still = replace(places, beam=False)
    keys = [e.key for e in freeform_effects(still, Extent.typical(still))]
    assert not [key for key in keys if "wave" in key]
    assert sum("warming" in key for key in keys) == 81


@pytest.mark.parametrize(
    "key",
    [
        "wave.v_b", "wave.v_b[0]", "wave.v_b[-1]", "wave.v_b[1..2]", "wave.v_b[1e999]",
        "wave.place[1]", "wave.phi_speed[1]", "wave", "warming.coil_9", "warming.coil_07",
        "warming.v_b", "warming",
    ],
)  # fmt: skip
def test_invalid_keys_give_no_effect(key: str):
    assert freeform_effect(rig_places(), f"unknown.{key}", ("sensor:1",)) is None


def test_invalid_locations_give_no_effect():
    for key, where in (
        ("wave.place", "theta"), ("wave.v_b[0.4]", "coil:1"), ("warming.coil_1", "theta"),
        ("warming.coil_1", "sensor:9"), ("answer.x_b*x_b", "sensor:1"), ("answer.x_b", "coil:1"),
    ):  # fmt: skip
        assert freeform_effect(rig_places(), f"unknown.{key}", (where,)) is None


@pytest.mark.parametrize("where", ["theta", "sensor:6"])
def test_resonant_response_of_the_base_to_the_beam(where: str):
    """The base is driven by a_b and loaded by x_b; the model has the weight and the reaction."""
    s, f_hz, zeta = swept(0.15), 1.9, 0.08
    w = 2 * np.pi * f_hz
    push = 0.4 * s.a_b_m_s2 - 9.81 * s.x_b_m
    _, turned, _ = lsim(([1.0], [1.0, 2 * zeta * w, w * w]), push, s.time_s)
    turning = push - 2 * zeta * w * np.gradient(turned, s.time_s) - w * w * turned
    effect = freeform_effect(rig_places(), "unknown.answer.x_b", (where,))
    assert depends_on(effect) == ("x_b",)
    at = {"theta": 1, "sensor:6": 6}[where]
    settled = slice(400, None)  # exp(-zeta w 4 s) is 2 %

    def share(frequency_hz: float) -> float:
        answered = [acts(t)[settled, at] for t in effect.build(s, (frequency_hz, zeta))]
        known = [x[settled] for x in (s.x_b_m, s.v_b_m_s, s.a_b_m_s2)]
        return explained([*known, *answered], (turning - turned)[settled])

    if where == "theta":
        itself = freeform_effect(rig_places(), "unknown.answer.x_b*x_b", (where,))
        assert depends_on(itself) == ("x_b",)
        for one, other in zip(*(e.build(s, (f_hz, zeta)) for e in (effect, itself)), strict=True):
            np.testing.assert_allclose(acts(one)[:, at] * s.x_b_m, acts(other)[:, at])
    assert share(f_hz) > 0.97  # sampling of 10 ms, and 2 % of the transient
    assert share(2.5) < 0.9
