"""Test the stability of the control loop against a known loop and against a simulated one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from repository_folders import SIMS

from levid.config.rig import FeedForward, RigConfig, load_rig
from levid.daemon.control.loop_stability import loop_stability

RIGS = SIMS.parent / "rigs"
RIG = load_rig(RIGS / "loopback.yaml")


def with_gains(factor: float, axis: str = "") -> RigConfig:
    text = RIG.control.model_dump()
    for name, gains in text.items():
        if axis in ("", name):
            text[name] = {key: factor * value for key, value in gains.items()}
    return RIG.model_copy(update={"control": type(RIG.control).model_validate(text)})


def grown(rig: RigConfig, seconds: float) -> float:
    """Return by how much a tilt of psi grows in a loop of numbers, one axis by itself.

    The numbers are those of the shipped model with the beam in its centre; steps are a hundredth
    of a period.
    """
    J, d, k = 0.062 + 1.4 * 0.06**2, 4.0 * 6 * 0.12**2, 210.0
    kp, ki = rig.control.kp[0], rig.control.ki[0]
    q, v, whole, lagged, held, acting = 1e-4, 0.0, 0.0, 0.0, 0.0, 0.0
    sizes = []
    for _ in range(round(seconds * 1000)):
        acting = held
        whole += -ki * 1e-3 * q
        held = -kp * q + whole
        for _ in range(100):
            lagged += 1e-5 * (acting - lagged) / 3e-4
            v += 1e-5 * (lagged - d * v - k * q) / J
            q += 1e-5 * v
        sizes.append(abs(q))
    early, late = np.array_split(np.array(sizes), 2)
    return float(late.max() / early.max())


def test_the_shipped_loops_have_a_margin() -> None:
    found = loop_stability(RIG, 1e-3)
    assert found is not None
    assert found.growth_s == np.inf
    assert 2.0 < found.gain_factor < 10.0


def test_ten_times_the_gains_is_unstable_and_told_by_how_much() -> None:
    found = loop_stability(with_gains(10.0), 1e-3)
    assert found is not None
    assert 0.01 < found.growth_s < 10.0
    plain = loop_stability(RIG, 1e-3)
    assert plain is not None
    # 201 factors are 2.3 % apart.
    assert found.gain_factor == pytest.approx(plain.gain_factor / 10.0, rel=0.05)


def test_a_simulated_axis_turns_unstable_at_the_same_gains() -> None:
    factors = np.geomspace(1.0, 20.0, 14)
    told = [loop_stability(with_gains(f, "psi"), 1e-3) for f in factors]
    edge = next(f for f, s in zip(factors, told, strict=True) if s and np.isfinite(s.growth_s))
    # The beam at its limit moves the edge by less than a third.
    assert grown(with_gains(0.6 * edge, "psi"), 6.0) < 1.0
    assert grown(with_gains(1.6 * edge, "psi"), 6.0) > 1.0


def test_a_rig_without_a_model_tells_nothing() -> None:
    own = FeedForward(mass_kg=7.0, beam_mass_kg=1.4, rods_n_m=0.0)
    rig = RIG.model_copy(update={"model": None, "feedforward": own})
    assert loop_stability(rig, 1e-3) is None


def test_check_refuses_gains_that_diverge(levid: Callable, tmp_path: Path) -> None:
    text = (RIGS / "loopback.yaml").read_text().replace("../", f"{RIGS.parent}/")
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    assert "; stable up to " in levid("check", path).out
    path.write_text(text.replace("kp_n_m: 500", "kp_n_m: 50000"))
    refused = levid("check", path)
    assert refused.code == 1
    said = "control: expected gains with which the loop is stable on the declared model, found a"
    assert said in refused.err
    # Along z, 36 N s/m of damping against kp times 1.8 ms: a cycle, half a held period, the lag.
    assert "of smaller gains, the loop is stable at 0.39 times these gains" in refused.err
