"""Numbers that make no sense together are said at `check`, and reasonable rigs get no warning."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from levid.config.base import ConfigError, parse
from levid.config.model import ModelConfig
from levid.config.rig import RigConfig, load_rig
from levid.config.shipped import shipped
from levid.daemon.planning.rig_plausibility import rig_problems

Command = Callable[..., tuple[int, str, str]]
RIG = yaml.safe_load(shipped("rigs/loopback.yaml").read_text())
MODEL = yaml.safe_load(shipped("models/rig.yaml").read_text())
TRIANGLE = ((0.12, -0.06, -0.06), (0.0, 0.104, -0.104))
"""Coils on a circle, 120 degrees apart."""


def scaled(length: float, mass: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the shipped rig and model with other lengths and masses, but as fast.

    Forces and what acts on z scale with the mass, what acts on a tilt with mass times length^2.
    """
    rig, model = yaml.safe_load(yaml.safe_dump(RIG)), yaml.safe_load(yaml.safe_dump(MODEL))
    torque = mass * length**2
    factors = {
        **dict.fromkeys(("r", "z_b"), length),
        **dict.fromkeys(("m_p", "m_b", "d", "k_z"), mass),
        **dict.fromkeys(
            ("J_psi", "J_theta", "J_psitheta", "k_psi", "k_theta", "k_psitheta"), torque
        ),
        **dict.fromkeys(("k_psiz", "k_thetaz"), mass * length),
    }
    for name, factor in factors.items():
        for key in {"value", "min", "max"} & model["parameters"][name].keys():
            model["parameters"][name][key] *= factor
    for key in ("coil_x_m", "coil_y_m"):
        rig["geometry"][key] = [length * x for x in rig["geometry"][key]]
    for dof, gains in rig["control"].items():
        for key in gains:
            gains[key] *= mass if dof == "z" else torque
    for key in ("coil_n", "coil_rate_n_s", "total_n", "coil_rms_n"):
        rig["limits"][key] *= mass
    rig["limits"]["beam_m"] *= length
    rig["limits"]["gap_m"] = min(rig["limits"]["gap_m"], 0.1 * length * 0.12)
    rig["limits"]["tilt_rad"] /= max(length, 0.07)
    return rig, model


def built(rig: dict[str, Any], model: dict[str, Any]) -> RigConfig:
    """Return a rig with its model."""
    parsed = parse(rig, RigConfig, "rig.yaml")
    return parsed.model_copy(update={"model": parse(model, ModelConfig, "model.yaml")})


def changed(path: str, value: object) -> dict[str, Any]:
    """Return the shipped rig with another value at a dotted path."""
    rig: dict[str, Any] = yaml.safe_load(yaml.safe_dump(RIG))
    *above, last = path.split(".")
    inner = rig
    for key in above:
        inner = inner[key]
    inner[last] = value
    return rig


def said(rig: dict[str, Any], model: dict[str, Any] = MODEL) -> str:
    """Return all that is said about a rig: its error, or its problems."""
    try:
        return "\n".join(map(str, rig_problems(built(rig, model))))
    except ConfigError as error:
        return str(error)


def written(folder: Path, rig: dict[str, Any], **others: str) -> Path:
    """Write a rig that names the shipped model and simulator; return its file."""
    named = {key: str(shipped(f"rigs/{RIG[key]}").resolve()) for key in ("model", "sim")}
    file = folder / "rig.yaml"
    file.write_text(yaml.safe_dump(rig | named | others))
    return file


@pytest.mark.parametrize("name", ["loopback", "can", "canfd", "serial"])
def test_shipped_rigs_are_plausible(name: str) -> None:
    assert rig_problems(load_rig(shipped(f"rigs/{name}.yaml"))) == []


@pytest.mark.parametrize(
    ("length", "mass"),
    [(4.0, 300.0 / 7.0), (8.0, 20.0), (0.08, 0.03 / 7.0), (0.5, 1.0), (1.0, 3.0)],
    ids=["1 m, 300 kg", "2 m, 140 kg", "20 mm, 30 g", "dense", "21 kg"],
)
def test_reasonable_rigs_get_no_warning(length: float, mass: float) -> None:
    assert said(*scaled(length, mass)) == ""


def test_triangle_of_three_coils_and_sensors_gets_no_warning() -> None:
    rig, model = scaled(1.0, 1.0)
    rig["geometry"] = dict(zip(("coil_x_m", "coil_y_m"), map(list, TRIANGLE), strict=True))
    rig["limits"] |= {"coil_n": 60.0, "coil_rms_n": 42.0}
    assert said(rig, model) == ""
    rig["feedforward"] = {"mass_kg": 5.6, "beam_mass_kg": 1.4, "rods_n_m": 2600}
    del rig["model"]
    assert [str(p) for p in rig_problems(parse(rig, RigConfig, "rig.yaml"))] == []


@pytest.mark.parametrize(("kp", "rods"), [(0.5, 0.0), (0.5, 2600.0), (0.0, 0.0)])
def test_gain_too_weak_to_hold_is_said_without_a_model_too(kp: float, rods: float) -> None:
    rig = changed("control.z.kp_n_m", kp)
    rig["feedforward"] = {"mass_kg": 5.6, "beam_mass_kg": 1.4, "rods_n_m": rods}
    del rig["model"]
    problems = rig_problems(parse(rig, RigConfig, "rig.yaml"))
    assert "control.z.kp_n_m" in {problem.key for problem in problems}
    assert problems[0].fatal == (kp == 0.0)


MM = [1e3 * x for x in RIG["geometry"]["coil_x_m"]]
WRONG = {
    "geometry.coil_x_m": (MM, "do you mean 0.12 m"),
    "geometry.coil_y_m": ([0.12, 0.0, -120.0, 0.12, 0.0, -0.12, 0.12, 0.0, -0.12], "0.12 m"),
    "geometry": (
        {key: [1e-3 * x for x in RIG["geometry"][key]] for key in RIG["geometry"]},
        "is it in m?",
    ),
    "geometry.coil_x_m ": ([1.2, *RIG["geometry"]["coil_x_m"][1:]], "another unit"),
    "control.z.kp_n_m": (0.5, "is it in N/mm?"),
    "control.psi.kp_n_m_rad": (0.02, "the rods alone hold psi"),
    "control.z.ki_n_m_s": (3.0, "only if the declared weight is right"),
    "control.z": ({"kp_n_m": 500, "ki_n_m_s": 3e6}, "found"),
    "limits.total_n": (13.0, "cannot lift off"),
    "limits.coil_rms_n": (1.4, "cannot hover"),
    "limits.coil_n": (10.2, "nothing is left to control with"),
    "limits.coil_rate_n_s": (40.0, "kN/s"),
    "limits.beam_velocity_m_s": (500.0, "in mm"),
    "limits.beam_acceleration_m_s2": (1e4, "in mm"),
    "limits.gap_m_s": (1.5e-4, "at lift-off"),
    "limits.gap_m": (8.5e-5, "is it in m?"),
}
"""Slips of a unit or a digit, and words of what is said."""


@pytest.mark.parametrize("path", WRONG)
def test_slip_of_a_unit_is_said_with_its_key(path: str) -> None:
    value, words = WRONG[path]
    found = said(changed(path.strip(), value))
    assert words in found
    assert path.strip().rpartition(".")[2] in found


@pytest.mark.parametrize(
    ("name", "factor", "words"),
    [
        ("J_psi", 1e6, "radius of gyration"),
        ("m_p", 1e3, "carrying the platform"),
    ],
)
def test_model_in_other_units_than_the_rig_is_said(name: str, factor: float, words: str) -> None:
    model = yaml.safe_load(yaml.safe_dump(MODEL))
    model["parameters"][name] = {"value": factor * 5.6, "unit": MODEL["parameters"][name]["unit"]}
    found = said(RIG, model)
    assert found
    assert words in found


def test_check_prints_the_slip_and_fails_only_if_the_rig_cannot_fly(
    levid: Command, tmp_path: Path
) -> None:
    for path, value, code in (
        ("control.z.kp_n_m", 0.5, 0),
        ("limits.coil_rms_n", 1.4, 1),
        ("name", "a" * 20_000, 1),
    ):
        rig = changed(path, value)
        rig["model"], rig["sim"] = (
            str(shipped("models/rig.yaml")),
            str(shipped("sims/nominal.yaml")),
        )
        file = tmp_path / "rig.yaml"
        file.write_text(yaml.safe_dump(rig))
        found, _, err = levid("check", file)
        assert found == code, err
        key = path.rpartition(".")[2]
        assert key in err
        assert len(err) < 1000


def test_rig_and_its_simulator_in_different_units_are_said(levid: Command, tmp_path: Path) -> None:
    rig_file = written(tmp_path, RIG, sim="sim.yaml")
    sim_file = tmp_path / "sim.yaml"
    sim = yaml.safe_load(shipped("sims/nominal.yaml").read_text())
    for path, value, code, words in (
        (("platform", "m_p_kg"), 5600.0, 1, "sim: coils.limit_n"),
        (("platform", "m_p_kg"), 0.056, 0, "warning: sim: the simulated platform weighs"),
        (("end_stops", "travel_m"), 0.0005, 0, "warning: limits.gap_m"),
        (("geometry", "coil_x_m"), MM, 1, "do you mean 0.12 m"),
    ):
        other = yaml.safe_load(yaml.safe_dump(sim))
        other[path[0]][path[1]] = value
        sim_file.write_text(yaml.safe_dump(other))
        rig_file.write_text(
            yaml.safe_dump(yaml.safe_load(rig_file.read_text()) | {"sim": "sim.yaml"})
        )
        found, _, err = levid("check", rig_file)
        assert found == code, err
        assert words in err


@pytest.mark.parametrize(
    ("step", "words"),
    [
        ("levitate: {ramp_s: 0.005}", "steps[0].levitate.ramp_s: expected"),
        ("levitate: {ramp_s: 1500}", "warning: steps[0].levitate.ramp_s: found 1500 s"),
    ],
)
def test_lift_off_in_other_units_is_said(
    step: str, words: str, levid: Command, tmp_path: Path
) -> None:
    file = tmp_path / "session.yaml"
    file.write_text(SESSION.replace("LEVEL", "0.05").replace("levitate: {}", step))
    code, _, err = levid("check", file)
    assert words in err
    assert (code == 0) == ("warning" in words)


SESSION = """
levid: session
name: strong
excitations:
  tilt: {input: psi, signal: white_noise, rms_n_m: LEVEL, band_hz: [1, 30]}
steps:
  - levitate: {}
  - record: {name: first, duration_s: 20, excite: [tilt]}
  - land: {}
"""


def test_session_too_strong_for_the_gap_or_the_coils_is_said_at_check(
    levid: Command, tmp_path: Path
) -> None:
    file = tmp_path / "session.yaml"
    rig_file = written(tmp_path, changed("limits.coil_rms_n", 7.65))
    for level, words in ((0.05, ""), (0.5, "gap up to")):
        file.write_text(SESSION.replace("LEVEL", str(level)))
        code, _, err = levid("check", file)
        assert (code == 0) == (words == ""), err
        assert words in err
    file.write_text(SESSION.replace("LEVEL", "0.9").replace("[1, 30]", "[100, 400]"))
    assert levid("check", file)[0] == 0
    code, _, err = levid("check", rig_file, file)  # the rig among the files, not the shipped one
    assert code == 1
    assert "coil_rms_n" in err
