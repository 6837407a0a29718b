"""Test shapes of modes over the sensors, on a plant whose equations are independent of levid's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from levid.benchmarks.identification.bending_platform import (
    COILS,
    Bearing,
    BendingMode,
    Platform,
    flights,
)
from levid.config.model import load_model
from levid.config.shipped import shipped
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.modes.identify_in_loop import LoopFit, identify_in_loop
from levid.identification.greybox.modes.mode_shapes import ModeShape, mode_shapes

SHAPE = np.array([1, 0.2, -0.6, 0.1, -0.4, 0.3, 0.8, -0.2, 0.5])
OTHER = np.array([-0.3, 0.7, 0.2, 1.0, 0.1, -0.6, 0.4, -0.8, 0.6])


@pytest.fixture(scope="module")
def flown() -> tuple[LoopFit, list[Experiment]]:
    modes = (BendingMode(95.0, 0.01, 3.0, SHAPE), BendingMode(160.0, 0.015, 4.0, OTHER))
    records = flights(Platform(modes, Bearing(3e5)), 1, duration_s=12.0)
    return identify_in_loop(load_model(shipped("models/rig.yaml")), records), records


@pytest.fixture(scope="module")
def shapes(flown: tuple[LoopFit, list[Experiment]]) -> dict[int, ModeShape]:
    fit, records = flown
    found = zip(fit.modes, mode_shapes(fit, records), strict=True)
    return {round(mode.freq_hz): shape for mode, shape in found if shape is not None}


@pytest.mark.parametrize(("freq_hz", "true"), [(95, SHAPE), (160, OTHER)])
def test_shape_is_within_its_errors_which_are_small(
    shapes: dict[int, ModeShape], freq_hz: int, true: np.ndarray
) -> None:
    found = shapes[freq_hz]
    # Nine values of two modes: the largest of 18 is 4 standard errors off once in 900 times.
    assert np.all(np.abs(found.shape - true) < 4.0 * found.se + 1e-9)
    assert found.se.max() < 0.02
    rigid = COILS @ np.linalg.lstsq(COILS, true, rcond=None)[0]
    assert found.rigid == pytest.approx(np.sum(rigid**2) / np.sum(true**2), abs=0.02)
    assert found.single > 0.9


def test_drive_by_coils_follows_by_reciprocity_and_agrees_with_the_wrench(
    shapes: dict[int, ModeShape],
) -> None:
    for found in shapes.values():
        assert found.reach is not None
        assert found.agreement > 0.95
    assert shapes[95].reach == pytest.approx(shapes[95].shape)


def test_body_on_the_structure_moves_the_platform_as_a_rigid_one(
    flown: tuple[LoopFit, list[Experiment]],
) -> None:
    fit, records = flown
    (bearing,) = (
        shape
        for mode, shape in zip(fit.modes, mode_shapes(fit, records), strict=True)
        if mode.kind == "attached"
    )
    assert bearing is not None
    assert bearing.rigid > 0.9


def test_coils_at_other_places_than_sensors_are_not_said_to_reach_it(
    flown: tuple[LoopFit, list[Experiment]],
) -> None:
    fit, records = flown
    moved = []
    for e in records:
        assert e.readings is not None
        moved.append(replace(e, readings=replace(e.readings, coils_m=e.readings.coils_m + 0.01)))
    assert all(s is not None and s.reach is None for s in mode_shapes(fit, moved))


def test_records_without_readings_have_no_shapes(
    flown: tuple[LoopFit, list[Experiment]],
) -> None:
    fit, records = flown
    without = [replace(e, readings=None) for e in records]
    assert mode_shapes(fit, without) == (None,) * len(fit.modes)
