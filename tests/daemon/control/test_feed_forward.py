"""The feed-forward of a rig's model: what it carries, which models it takes, what theta gains."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from levid.config.base import ConfigError, parse_text
from levid.config.model import ModelConfig, load_model
from levid.config.rig import FeedForward, RigConfig, load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.daemon.control.feed_forward import feed_forward
from levid.daemon.loop.virtual_session import fly_virtually
from levid.log.reader import read_log

RIG_FILE, MODEL_FILE = shipped("rigs/loopback.yaml"), shipped("models/rig.yaml")
RIG, MODEL = load_rig(RIG_FILE), load_model(MODEL_FILE)
PERIOD_S = 1e-3
NUMBERS = {"mass_kg": 7.0, "beam_mass_kg": 1.4, "rods_n_m": 2600}


def with_own_numbers(rig: RigConfig = RIG) -> RigConfig:
    plain = rig.model_dump(mode="json", exclude={"model"}) | {"feedforward": NUMBERS}
    return RigConfig.model_validate(plain)


def with_changed(**changes: object) -> RigConfig:
    model = ModelConfig.model_validate({**MODEL.model_dump(mode="json"), **changes})
    return RIG.model_copy(update={"model": model})


def test_wrench_of_the_shipped_model_is_weight_and_what_the_beam_does() -> None:
    rng = np.random.default_rng(1)
    beam = rng.uniform(-1, 1, (20, 3)) * [0.1, 0.5, 10]
    x, v, a = beam.T
    m, m_b, z_b, g = 7.0, 1.4, 0.06, 9.81
    ahead_s = 1.5e-3 + 0.3e-3  # to the middle of the period in which it acts, behind the lag
    theta = m_b * g * (x + ahead_s * v) - m_b * z_b * a
    expected = np.stack([0 * x, theta, 0 * x + m * g], axis=1)
    law = feed_forward(RIG, PERIOD_S)
    np.testing.assert_allclose(law.wrench(beam), expected, rtol=1e-12, atol=1e-12)
    assert not law.left_over.max() > 1e-12  # rounding: it is linear


def test_a_rig_with_its_own_numbers_carries_weight_and_beam_alone() -> None:
    law = feed_forward(with_own_numbers(), PERIOD_S)
    expected = [[0.0, 1.4 * 9.81 * 0.05, 7.0 * 9.81]]
    np.testing.assert_allclose(law.wrench(np.array([[0.05, 0.4, 9.0]])), expected, rtol=1e-12)
    assert law.rods_n_m == 2600.0
    assert not law.by_model.any()


def test_names_of_a_model_are_its_own_and_wrenches_go_through_its_B() -> None:
    theirs = MODEL_FILE.read_text().replace("x_b", "sled").replace("m_b", "load")
    model = parse_text(theirs.replace("delay_s:", f"B: {np.diag([2, 2, 2]).tolist()}\ndelay_s:"),
                       ModelConfig, "theirs")  # fmt: skip
    law = feed_forward(RIG.model_copy(update={"model": model}), PERIOD_S)
    own = feed_forward(RIG, PERIOD_S)
    np.testing.assert_allclose(law.by_model, 0.5 * own.by_model, rtol=1e-12)


def test_what_is_not_linear_is_left_and_told(levid: Callable, tmp_path: Path) -> None:
    cubic = [0, "-m_b*g*x_b + 500*x_b**3", "-(m_p + m_b)*g"]
    law = feed_forward(with_changed(force=cubic), PERIOD_S)
    # Through the values at 0 and +-0.1: in between x^3 is off by 0.375 of its value at the end.
    np.testing.assert_allclose(law.left_over, [0, 500 * 0.375e-3, 0], atol=1e-12)
    (tmp_path / "model.yaml").write_text(
        yaml.safe_dump({**MODEL.model_dump(mode="json", exclude_none=True), "force": cubic})
    )
    text = RIG_FILE.read_text().replace("../models/rig.yaml", "model.yaml")
    (tmp_path / "rig.yaml").write_text(
        text.replace("../sims/nominal.yaml", str(shipped("sims/nominal.yaml")))
    )
    said = levid("check", tmp_path / "rig.yaml").out
    assert "feed-forward up to 8.85 N a coil (linear" in said
    assert "by up to 0.26 N" in said  # 0.1875 N m at 0.12 m, of 6 coils


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"dof": [{"name": n, "unit": "m"} for n in "xyz"]}, "found x in m, y in m, z in m"),
        ({"inputs": [{"name": n, "unit": "N"} for n in "xyz"]}, "found psi in rad, .* in N, N, N"),
        ({"B": np.zeros((3, 3)).tolist()}, "B: expected an invertible matrix"),
        ({"force": [0, 0, "-m_p*g/x_b"]}, "has no value"),
        ({"delay_s": 1e9}, r"lag_s and delay_s: expected at most 0.0132 s together, .* 1e\+09 s"),
        ({"force": [0, 0, "-1000*m_p*g"]}, r"needs 6.1e\+03 N in a coil, expected at most"),
        (
            {"scheduling": {n: {"unit": "K", "signal": "heat"} for n in ("x_b", "v_b", "a_b")}},
            "force: expected position, velocity or acceleration of the beam .* found 'a_b'",
        ),
    ],
)
def test_a_model_that_does_not_fit_the_rig_is_an_error_in_words(changes, said: str) -> None:
    with pytest.raises(ConfigError, match=f"rig loopback: model rig: .*{said}"):
        feed_forward(with_changed(**changes), PERIOD_S)


def test_either_a_model_or_numbers(tmp_path: Path) -> None:
    text = RIG_FILE.read_text()
    for found, changed in (
        ("both", text.replace("limits:", f"feedforward: {NUMBERS}\nlimits:")),
        ("neither", text.replace("model:", "# model:")),
        ("cannot be read", text),
    ):
        (tmp_path / "rig.yaml").write_text(changed)
        with pytest.raises(ConfigError, match=found):
            load_rig(tmp_path / "rig.yaml")


SWEEP = """
levid: session
name: sweep
seed: 1
steps:
  - levitate: {settle_s: 1}
  - record:
      name: sweep
      duration_s: 5
      beam:
        - {to_m: 0.08, velocity_m_s: 0.3, acceleration_m_s2: 1.5}
        - {to_m: 0.05, velocity_m_s: 0.4, acceleration_m_s2: 3.0}
        - {to_m: 0.0, velocity_m_s: 0.15, acceleration_m_s2: 0.5}
  - land: {}
"""


def theta_rms(rig: RigConfig, sim: str, out: Path) -> float:
    """Return by how much theta strays while the beam moves, in rad RMS."""
    session = parse_text(SWEEP, SessionConfig, "sweep")
    rig = rig.model_copy(update={"sim": str(shipped(f"sims/{sim}.yaml"))})
    flown = fly_virtually(rig, RIG_FILE, session, SWEEP.encode(), out)
    (record,) = flown.records
    return float(np.sqrt(np.mean(read_log(record).rows["theta_rad"][3000:].astype(float) ** 2)))


@pytest.mark.parametrize("sim", ["nominal", "rig"])
def test_theta_hardly_notices_a_beam_that_the_model_knows(sim: str, tmp_path: Path) -> None:
    before = theta_rms(with_own_numbers(), sim, tmp_path / "before")
    # The planned acceleration is of the end of the period in which the force acts. Half a period,
    # at theta's resonance of 53 rad/s, is 2.7 % of what it was.
    assert theta_rms(RIG, sim, tmp_path / "after") < 0.03 * before


@pytest.mark.parametrize("own", [True, False])
def test_a_coil_limit_in_other_units_is_an_error(own: bool) -> None:
    limits = RIG.limits.model_copy(update={"coil_n": 20e3})
    changes: dict[str, object] = {"limits": limits}
    if own:
        changes |= {
            "model": None,
            "feedforward": FeedForward(mass_kg=7.0, beam_mass_kg=1.4, rods_n_m=0.0),
        }
    with pytest.raises(ConfigError, match=r"limits\.coil_n: .* found 20000; is it in mN\?"):
        feed_forward(RIG.model_copy(update=changes), PERIOD_S)
    changes["limits"] = RIG.limits.model_copy(update={"coil_n": 1e308})
    with pytest.raises(ConfigError, match=r"found 1e\+308$"):
        feed_forward(RIG.model_copy(update=changes), PERIOD_S)
