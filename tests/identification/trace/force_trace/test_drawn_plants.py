"""Test the trace of imported records on drawn plants of five kinds, simulated independently.

The seeds are some that showed a mistake once, or a law that was new;
benchmarks/trace/imported_plants.py draws new ones.
"""

from __future__ import annotations

from typing import Any

import pytest

from levid.benchmarks.trace import imported_plants
from levid.benchmarks.trace.imported_plants import scored
from levid.model.effects.base import Effect
from levid.model.effects.candidate_effects import all_effects


@pytest.mark.parametrize(
    ("plant", "law", "seed"),
    [
        ("pendulum", "loose_mass", 700_000),  # a resonance at 0.67 Hz
        ("stage", "saturation", 700_000),  # of the torque, which is a sixtieth of the force
        ("drive", "quantised", 700_000),  # 33 levels
        ("drive", "force_ripple", 700_000),
        ("pendulum", "uneven_friction", 700_000),  # its period is longer than the travel
        ("drive", "preload", 898_001),
        ("drive", "preload", 951_001),  # a spring that levels off has the better start values
        ("pendulum", "hysteresis", 900_001),
        ("levitation", "bearing", 900_003),
        ("drive", "soft_spring", 897_001),
        ("pendulum", "stop", 620_001),  # a detent would do, whose other end no fitted row reaches
        ("pendulum", "buffer", 620_001),
        ("drive", "permanent_magnet", 897_001),  # an exponential spring hardens in the same way
        ("pendulum", "quintic", 897_002),
        ("pendulum", "foam", 897_002),
        ("pendulum", "cubic_damper", 897_002),
        ("geared", "shaft", 992_001),  # narrow: a creeping spring is confirmed before it
        ("pendulum", "drift", 700_000),  # a law of heat with a long time constant is alike
    ],
)
def test_the_effect_of_a_plant_is_named(plant: str, law: str, seed: int) -> None:
    found = scored(plant, law, seed)
    assert found.right
    assert not found.false_name
    assert not found.doubtful
    assert found.force[1] < 0.4 * found.force[0]


def test_a_law_whose_size_is_not_told_from_zero_is_named() -> None:
    """Size, gap and current of a bearing of 1 % of the force change together: it is in doubt."""
    found = scored("levitation", "bearing", 900_005)
    assert found.right
    assert not found.false_name


@pytest.mark.parametrize(
    ("law", "seed"),
    [
        ("preload", 900_001),  # reached slowly: so is a spring that levels off
        ("slow_friction", 895_001),  # not far below the speeds: a damping that falls with them
        ("lag", 862_001),  # of an open loop: so is one of its sensor
        ("delay", 700_001),  # shorter than a period: a lag is alike
        ("gravity", 750_001),  # of a small swing: so is a cubic stiffness
        ("cubic_stiffness+coulomb", 877_001),  # which gained nothing before friction was found
    ],
)
def test_what_a_pendulum_does_not_tell_apart_is_a_group(law: str, seed: int) -> None:
    found = scored("pendulum", law, seed)
    assert found.in_group
    assert not found.false_name


def test_a_mass_on_a_spring_is_not_lost_to_a_play_that_never_moves() -> None:
    # Wider than the command's range, the play of a hysteresis is the input's own gain.
    found = scored("pendulum", "gravity+loose_mass", 871_001)
    assert found.right
    assert not found.false_name
    assert not found.doubtful


def test_a_load_that_is_measured_is_no_second_load() -> None:
    """In its place, one that only the motor moves would keep the noise of the twist out."""
    found = scored("geared", "drifting_stiffness", 951_003)
    assert found.right
    assert not found.false_name
    assert all(ok for ok, _ in found.inside)


def test_a_contact_is_found_from_a_start_at_zero() -> None:
    found = scored("pendulum", "stop", 700_000)
    assert found.right
    assert all(ok for ok, _ in found.inside)


def test_a_name_is_in_doubt_where_a_free_form_explains_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def without(*args: Any) -> tuple[Effect, ...]:
        return tuple(e for e in all_effects(*args) if e.key != "friction.along_position")

    # If friction that changes along the way is not in the table, Coulomb friction is its best.
    monkeypatch.setattr(imported_plants, "all_effects", without)
    found = scored("drive", "uneven_friction", 700_000)
    assert found.doubtful


def test_a_free_form_does_not_share_out_what_a_law_describes() -> None:
    # The drag is |v|^1.5; a curve over speed beside the quadratic law would change its numbers.
    found = scored("pendulum", "drag_15", 700_000)
    assert found.right
    assert not found.free_form


def test_two_effects_that_look_like_a_third_one_are_found() -> None:
    # Friction, and a force that grows faster than its command: together an elastic friction.
    found = scored("drive", "cubic_actuator+coulomb", 750_001)
    assert found.right
    assert not found.false_name
    assert found.force[1] < 1.0


@pytest.mark.parametrize(
    ("law", "seed"),
    [
        ("stribeck+drag", 877_001),  # alone, eddy currents leave about as much, with fewer numbers
        ("cubic_actuator+coulomb", 879_001),  # a lag leaves much more, most of it in few blocks
    ],
)
def test_two_effects_of_a_drive_are_told_from_one(law: str, seed: int) -> None:
    found = scored("drive", law, seed)
    assert found.right
    assert not found.false_name
    assert not found.doubtful


def test_two_large_effects_are_found_whose_gains_scatter_without_each_other() -> None:
    # A swinging mass beside a sine for a stiffness: alone, neither is told from chance by blocks.
    found = scored("pendulum", "gravity+loose_mass", 862_001)
    assert found.right
    assert not found.doubtful
    assert found.force[1] < 0.02 * found.force[0]


@pytest.mark.parametrize(("plant", "seed"), [("drive", 895_002), ("pendulum", 902_001)])
def test_friction_that_levels_off_slowly_is_told_from_one_that_turns_fast(
    plant: str, seed: int
) -> None:
    # Both have two numbers, so the one that surely takes more is named, however little it is.
    found = scored(plant, "slow_friction", seed)
    assert found.right
    assert not found.doubtful
    assert all(inside for inside, _ in found.inside)


def test_friction_that_turns_within_the_speeds_is_in_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    def without(*args: Any) -> tuple[Effect, ...]:
        smooth = ("damping.falling", "damping.eddy_current")
        return tuple(e for e in all_effects(*args) if e.key not in smooth)

    # If damping that levels off is not in the table, a friction with a slow turn is its best.
    monkeypatch.setattr(imported_plants, "all_effects", without)
    found = scored("drive", "thinning_grease", 862_001)
    assert not found.sure_and_false
