"""Test the hooks of effects: order of calls, results, errors."""

import os
import py_compile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from repository_folders import SIMS

from levid.config.base import load_yaml
from levid.config.sim import SimConfig, SimEffect
from levid.sim.effects import EffectError, Effects
from levid.sim.effects.check_effect_source import check_effects
from levid.sim.effects.ground_vibration import GroundNoise, GroundTone
from levid.sim.plant import Plant

NONE = np.zeros(3)
Array = NDArray[np.float64]

EFFECTS = '''
import numpy as np

class Everything:
    """Has every hook, changes nothing, and spoils whatever it is handed."""
    def __init__(self, calls):
        self.calls = calls
    def reset(self, plant):
        self.calls.append(("reset", plant.dt_s))
        assert plant.rng.standard_normal() != 0
        g = plant.geometry
        assert g.r_m == 0.12 and g.beam_z_m == 0.06 and g.coil_x_m.shape == g.coil_y_m.shape == (9,)
    def coil_force(self, t_s, q, force_n):
        self.calls.append(("coil_force", t_s))
        answer = force_n.copy()
        q[:], force_n[:] = 1e9, 1e9
        return answer
    def wrench(self, t_s, q, qd, beam):
        self.calls.append(("wrench", t_s))
        beam.x_m, beam.v_m_s, beam.a_m_s2, beam.phi_rad, beam.phi_rad_s, beam.phi_rad_s2
        q[:], qd[:] = 1e9, 1e9
        return [0.0, 0.0, 0.0]
    def mass(self, t_s):
        self.calls.append(("mass", t_s))
        return np.zeros((3, 3))
    def beam_force(self, t_s, beam, q, qd):
        self.calls.append(("beam_force", t_s))
        q[:], qd[:] = 1e9, 1e9
        return 0.0
    def gap(self, t_s, gap_m):
        self.calls.append(("gap", t_s))
        answer = gap_m.copy()
        gap_m[:] = 1e9
        return answer

class Wrench:
    def __init__(self, *, psi_n_m=0.0, theta_n_m=0.0, z_n=0.0):
        self.tau = np.array([psi_n_m, theta_n_m, z_n])
    def wrench(self, t_s, q, qd, beam):
        return self.tau

class Spring:
    """A rod more, along z: linear and cubic."""
    def __init__(self, k_n_m, cubic_n_m3=0.0):
        self.k, self.cubic = k_n_m, cubic_n_m3
    def wrench(self, t_s, q, qd, beam):
        return [0, 0, -self.k * q[2] - self.cubic * q[2] ** 3]

class Payload:
    def __init__(self, mass_kg):
        self.added = np.diag([0, 0, mass_kg])
    def mass(self, t_s):
        return self.added

class Gain:
    def __init__(self, factor, offset_n=0.0):
        self.factor, self.offset = factor, offset_n
    def coil_force(self, t_s, q, force_n):
        return self.factor * force_n + self.offset

class Bearing:
    def beam_force(self, t_s, beam, q, qd):
        return -2.0

class Sensor:
    def gap(self, t_s, gap_m):
        gap_m[4] += 1e-4
        return gap_m

class Wrong:
    def __init__(self, answer):
        self.answer = answer
    def wrench(self, t_s, q, qd, beam):
        return {"nan": [0, 0, float("nan")], "size": [0, 0], "none": None, "text": "a",
                "raise": None}[self.answer] if self.answer != "raise" else 1 / 0

class Lopsided:
    def mass(self, t_s):
        return [[0, 1, 0], [0, 0, 0], [0, 0, 0]]

class Vanishing:
    def mass(self, t_s):
        return -np.eye(3)

class Nothing:
    pass

class Picky:
    def __init__(self, size):
        if size < 0:
            raise ValueError("size below zero")
    def reset(self, plant):
        pass
'''


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "effects").mkdir()
    (tmp_path / "effects" / "mine.py").write_text(EFFECTS)
    return tmp_path


def build(folder: Path, effects: list[dict[str, Any]], name: str = "nominal", **kw: Any) -> Plant:
    config = load_yaml(SIMS / f"{name}.yaml", SimConfig).model_dump()
    for effect in effects:
        if ":" not in effect["use"]:
            effect["use"] = f"effects/mine.py:{effect['use']}"
    config["effects"] = effects
    for section, values in kw.items():
        config[section] |= values
    return Plant(SimConfig.model_validate(config), 1e-3, source=folder / "SIM.yaml")


def fly(plant: Plant, periods: int = 40, force_n: float = 8.2) -> list[bytes]:
    """Lift off and fly free, the beam moving; the readings of every period, bit for bit."""
    seen = []
    for i in range(periods):
        x = 1e-3 * i
        ref = np.array([0.05 * x**2, 0.1 * x, 0.1])
        plant.advance(np.full(9, force_n), ref, ref)
        plant.sample()
        readings = (plant.gap_m, plant.coil_readback_n, plant.beam, plant.rotor)
        seen.append(b"".join(part.tobytes() for part in readings))
    return seen


@pytest.mark.parametrize("name", ["nominal", "rig"])
def test_effect_without_contribution_changes_no_bit(folder: Path, name: str) -> None:
    everything = build(folder, [{"use": "Everything", "calls": []}], name)
    assert fly(everything) == fly(build(folder, [], name))


def test_hooks_are_called_once_a_step_in_their_order(folder: Path) -> None:
    calls: list[tuple[str, float]] = []
    plant = build(folder, [{"use": "Everything", "calls": calls}])
    assert calls == [("reset", 1e-4), ("gap", 0.0)]
    plant.advance(np.zeros(9), NONE, NONE)
    plant.advance(np.zeros(9), NONE, NONE)
    assert [hook for hook, _ in calls[2:]] == 20 * [
        "coil_force",
        "wrench",
        "mass",
        "beam_force",
        "gap",
    ]
    times = np.array([t for _, t in calls[2:]]).reshape(20, 5)
    np.testing.assert_allclose(times[:, :4], np.arange(20)[:, None] * np.full(4, 1e-4), atol=1e-12)
    np.testing.assert_allclose(times[:, 4], np.arange(1, 21) * 1e-4, atol=1e-12)


def test_effects_rng_is_their_own_and_seeded(folder: Path) -> None:
    """Each effect has its own stream, whatever stands beside it; the noise has another."""
    (folder / "noisy.py").write_text(
        "class Noisy:\n"
        "    def reset(self, plant): self.rng = plant.rng\n"
        "    def wrench(self, t_s, q, qd, beam): return self.rng.standard_normal(3)\n"
    )
    noisy = {"use": "noisy.py:Noisy"}
    once, again = (fly(build(folder, [dict(noisy)])) for _ in range(2))
    beside = fly(build(folder, [dict(noisy), {"use": "Wrench"}]))
    assert once == again == beside
    assert once != fly(build(folder, []))


def test_wrench_and_coil_force_push_like_coils(folder: Path) -> None:
    """9 N up from outside, or 1 N more a coil: the same motion; the readback knows neither."""
    plain = build(folder, [])
    outside = build(folder, [{"use": "Wrench", "z_n": 9.0}])
    coils = build(folder, [{"use": "Gain", "factor": 1.0, "offset_n": 1.0}])
    for plant in (plain, outside, coils):
        fly(plant)
    np.testing.assert_allclose(outside.pose, coils.pose, rtol=1e-12, atol=1e-18)
    np.testing.assert_array_equal(plain.coil_readback_n, coils.coil_readback_n)
    assert outside.pose[2] > plain.pose[2] + 1e-4


def test_effects_chain_in_the_order_of_the_list(folder: Path) -> None:
    """Half of (F + 2 N) is F / 2 + 1 N; the other way round it is F / 2 + 2 N."""
    add, half = {"use": "Gain", "factor": 1.0, "offset_n": 2.0}, {"use": "Gain", "factor": 0.5}
    both = {"use": "Gain", "factor": 0.5, "offset_n": 1.0}
    chained = build(folder, [dict(add), dict(half)])
    single = build(folder, [both])
    turned = build(folder, [dict(half), dict(add)])
    for plant in (chained, single, turned):
        fly(plant, force_n=16.0)
    np.testing.assert_allclose(chained.pose, single.pose, rtol=1e-9)
    assert turned.pose[2] > chained.pose[2] + 1e-4


def test_spring_effect_equals_a_stiffer_rod(folder: Path) -> None:
    """Held over steps of 0.1 ms its force is half a step old: with z / v of 20 ms or more, that
    is 3e-3 of it at most."""
    effect = build(folder, [{"use": "Spring", "k_n_m": 500.0}])
    rod = build(folder, [], rods={"k_z_n_m": 3100.0})
    none = build(folder, [])
    for plant in (effect, rod, none):
        fly(plant, periods=50, force_n=0.0)  # the stops come to rest
        fly(plant)
    difference = abs(rod.pose[2] - none.pose[2])
    assert difference > 2e-5
    assert abs(effect.pose[2] - rod.pose[2]) < 3e-3 * difference


def test_added_mass_divides_the_acceleration(folder: Path) -> None:
    """In free flight, with 7 kg more (and no more weight) half the acceleration."""
    plain, heavy = build(folder, []), build(folder, [{"use": "Payload", "mass_kg": 7.0}])
    gained = []
    for plant in (plain, heavy):
        fly(plant, periods=5, force_n=12.0)
        before = plant.pose_rate[2]
        fly(plant, periods=5, force_n=12.0)
        gained.append(plant.pose_rate[2] - before)
    # Rods and air differ by less than 1 N between the two, of 39 N net.
    assert gained[1] / gained[0] == pytest.approx(0.5, abs=0.025)


def test_beam_force_is_internal_and_shows_in_the_drive(folder: Path) -> None:
    plain, dragged = build(folder, []), build(folder, [{"use": "Bearing"}])
    fly(plain)
    fly(dragged)
    np.testing.assert_array_equal(plain.gap_m, dragged.gap_m)
    assert dragged.beam[2] - plain.beam[2] == pytest.approx(2.0, abs=1e-12)


def test_beam_force_moves_the_beam_of_a_real_drive(folder: Path) -> None:
    plain, dragged = build(folder, [], "rig"), build(folder, [{"use": "Bearing"}], "rig")
    for plant in (plain, dragged):
        for _ in range(300):
            plant.advance(np.zeros(9), NONE, NONE)
        plant.sample()
    # The loop's integrator carries it after 0.3 s; Coulomb friction of 0.3 N may help.
    assert dragged.beam[2] - plain.beam[2] == pytest.approx(2.0, abs=0.35)
    assert abs(dragged.beam[0]) < 1e-6


def test_gap_is_what_the_sensor_sees_before_its_noise(folder: Path) -> None:
    plain, seen = build(folder, []), build(folder, [{"use": "Sensor"}])
    shift = seen.gap_m - plain.gap_m
    # Within the converter's step of 31 nm; the stops' rest at -0.908 mm leaves room below 1 mm.
    np.testing.assert_allclose(shift, 1e-4 * np.eye(9)[4], atol=3.1e-8)


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        ({"use": "Missing"}, "no class 'Missing'.*its classes: Everything"),
        ({"use": "Spring"}, "missing a required argument: 'k_n_m'"),
        ({"use": "Spring", "k_n_m": 1.0, "k_mm": 1.0}, "unexpected keyword argument 'k_mm'"),
        ({"use": "nowhere.py:Spring"}, "no file .*nowhere.py"),
        ({"use": "no_such_package.module:Spring"}, "cannot import no_such_package"),
        ({"use": "Nothing"}, "more of reset, coil_force"),
        ({"use": "Picky", "size": -1}, "ValueError: size below zero"),
    ],
)
def test_effect_that_cannot_be_loaded_is_named(
    folder: Path, effect: dict[str, Any], message: str
) -> None:
    with pytest.raises(EffectError, match=rf"SIM\.yaml: effects\[0\] \(.*\).*{message}"):
        build(folder, [effect])


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ("nan", "finite numbers"),
        ("size", r"expected shape \(3,\), found shape \(2,\)"),
        ("none", r"expected shape \(3,\), found None"),
        ("text", r"expected numbers of shape \(3,\)"),
        ("raise", "raised ZeroDivisionError"),
    ],
)
def test_wrong_answer_is_named(folder: Path, answer: str, message: str) -> None:
    plant = build(folder, [{"use": "Wrench"}, {"use": "Wrong", "answer": answer}])
    with pytest.raises(EffectError, match=rf"SIM\.yaml: effects\[1\] \(.*\): wrench.*{message}"):
        fly(plant)


def test_impossible_mass_is_named(folder: Path) -> None:
    with pytest.raises(EffectError, match="symmetric"):
        fly(build(folder, [{"use": "Lopsided"}]))
    with pytest.raises(EffectError, match="positive definite"):
        fly(build(folder, [{"use": "Vanishing"}], "rig"))


@pytest.mark.parametrize("mode", [0o646, 0o666, 0o664, 0o660, 0o620])
def test_file_that_others_may_change_is_not_executed(folder: Path, mode: int) -> None:
    file = folder / "effects" / "mine.py"
    file.chmod(mode)
    if not mode & 0o002:
        if os.getuid() != 0:
            pytest.skip("only root can give a file to a group that it is not in")
        os.chown(file, -1, 4242)
    place = folder / "SIM.yaml"
    effect = SimEffect.model_validate({"use": "effects/mine.py:Bearing"})
    for load in (check_effects, Effects):
        with pytest.raises(EffectError, match=r"mine.py: its code is not executed: .*may change"):
            load([effect], place)
    file.chmod(0o644)
    Effects([effect], place)


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file away")
def test_file_of_another_user_is_not_executed(folder: Path) -> None:
    os.chown(folder / "effects" / "mine.py", 65534, -1)
    effect = SimEffect.model_validate({"use": "effects/mine.py:Bearing"})
    for load in (check_effects, Effects):
        with pytest.raises(EffectError, match=r"it belongs to user .*, who can change it"):
            load([effect], folder / "SIM.yaml")


def test_bytecode_beside_the_file_is_not_executed(folder: Path) -> None:
    """Whoever may write to the folder's __pycache__ cannot replace the code."""
    file = folder / "effects" / "mine.py"
    file.write_text("raise SystemExit('bytecode')\n")
    never = py_compile.PycInvalidationMode.UNCHECKED_HASH
    py_compile.compile(str(file), invalidation_mode=never)
    file.write_text(EFFECTS)
    Effects([SimEffect.model_validate({"use": "effects/mine.py:Bearing"})], folder / "SIM.yaml")


def test_class_without_hooks_is_not_even_constructed(folder: Path, tmp_path: Path) -> None:
    """A SIM.yaml may name any class of Python, one that starts programs too."""
    touched = tmp_path / "touched"
    effect = {"use": "subprocess:Popen", "args": ["touch", str(touched)]}
    with pytest.raises(EffectError, match="expected a class with one or more of"):
        Effects([SimEffect.model_validate(effect)], folder / "SIM.yaml")
    assert not touched.exists()


def test_module_effect_is_found(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(folder / "effects"))
    plain, pushed = build(folder, []), build(folder, [{"use": "mine:Wrench", "z_n": 5.0}])
    fly(plain)
    fly(pushed)
    assert pushed.pose[2] > plain.pose[2]


def test_file_is_sought_in_the_working_folder_too(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    config = load_yaml(SIMS / "nominal.yaml", SimConfig).model_dump()
    config["effects"] = [{"use": "effects/mine.py:Wrench"}]
    Plant(SimConfig.model_validate(config), 1e-3, source=tmp_path / "elsewhere" / "SIM.yaml")
    Plant(SimConfig.model_validate(config), 1e-3)


@pytest.mark.parametrize(
    ("old", "new"), [("floor:FloorTone", GroundTone), ("floor:FloorNoise", GroundNoise)]
)
def test_effects_keep_the_names_that_older_files_use(old: str, new: type) -> None:
    values = {"mass_kg": 7.0, "m_b_kg": 1.4}
    values |= {"acceleration_m_s2": 0.1, "freq_hz": 17.0} if new is GroundTone else {}
    values |= {"rms_m_s2": 0.05, "band_hz": (5.0, 40.0)} if new is GroundNoise else {}
    effect = SimEffect(use=f"levid.sim.effects.{old}", **values)
    assert Effects([effect], None).uses("wrench")
