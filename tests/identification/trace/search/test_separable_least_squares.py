"""Test the fit of shapes along fixed trajectories: known answers, bounds, and the full fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from declared_model_records import PLACES, SHAPE, TS, point, record

from levid.identification.greybox.prediction.discretisation import innovations, motion
from levid.identification.trace.linearised.linearisation_point import (
    WorkingPoint,
    corrected_experiment,
    filtered,
)
from levid.identification.trace.linearised.linearise_prediction_errors import linearise
from levid.identification.trace.records.record_from_log import TraceRecord
from levid.identification.trace.search.gauss_newton import Candidate, gather
from levid.identification.trace.search.regression import remaining, solve
from levid.identification.trace.search.separable_least_squares import with_fitted_shapes
from levid.identification.trace.search.tested_candidate import Tried
from levid.model.effects.base import Placed, Term
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

EFFECTS = {e.identity: e for e in all_effects(PLACES, Extent.typical(PLACES))}
COULOMB, DAHL, CUBIC = "friction.coulomb@z", "friction.dahl@z", "rod_stiffness.cubic@z"
FORCE_N, SPEED_M_S = 0.02, 2e-3
LINE_HZ = 23.0


class OneRecord:
    """A record of a plant with friction."""

    def __init__(self, made: TraceRecord) -> None:
        self.made, self.asked = made, 0

    def train(self, at: WorkingPoint, candidates: tuple[Candidate, ...] = (), only=None):
        self.asked += 1
        return [linearise(at, self.made, list(candidates))]


def started(identity: str, *shape: float) -> Tried:
    effect = EFFECTS[identity]
    amplitudes = (0.004,) * len(effect.amplitudes)
    return Tried(effect, shape, 0.0, np.zeros(1), amplitudes)


def moved_by(force: np.ndarray, made: TraceRecord) -> np.ndarray:
    """Return the motion (rows, n) that forces add to that of the linear plant."""
    here, at = point(), motion(point().model, made.experiment, "zoh")
    still = np.zeros((made.rows, 6, 3))  # a filter that reads nothing is the plant

    def answer(some: np.ndarray) -> np.ndarray:
        _, driven = corrected_experiment(here, made, at, Term(force=some))
        return -innovations(driven, still, np.zeros_like(made.experiment.y), np.zeros(6))

    return answer(force) - answer(np.zeros_like(force))


def with_motion(made: TraceRecord, moved: np.ndarray) -> TraceRecord:
    """Return a record with more motion."""
    e = replace(made.experiment, y=made.experiment.y + moved)
    return replace(made, experiment=e, gap=made.gap + moved @ SHAPE.T)


@pytest.fixture(scope="module")
def rubbing() -> TraceRecord:
    """Return a record of a linear plant that a Coulomb friction along its own motion acts on.

    The force that the friction has along a trajectory moves the plant, which changes that
    trajectory: so small a friction agrees with its own after some passes.
    """
    here, made = point(), record("moving", 21_000)
    at = motion(here.model, made.experiment, "zoh")
    pushed = np.zeros((made.rows, 3))
    signals, _ = filtered(here, made, at)
    for _ in range(5):
        placed = Placed(EFFECTS[COULOMB], (SPEED_M_S,), (FORCE_N,))
        moved = moved_by(pushed, made)
        speed = np.gradient(moved, TS, axis=0)
        along_it = replace(signals, q=signals.q + moved, qd=signals.qd + speed)
        force = placed.term(along_it).force
        assert force is not None
        pushed = force
    return with_motion(made, moved_by(pushed, made))


@pytest.mark.parametrize("start", [2e-4, 1e-3, 5e-3])
def test_shape_and_amplitude_are_found_from_any_start(rubbing: TraceRecord, start: float) -> None:
    (found,) = with_fitted_shapes(point(), [started(COULOMB, start)], OneRecord(rubbing))
    # The friction was put on a trajectory of finite differences, and the readings have noise.
    assert found.shape[0] == pytest.approx(SPEED_M_S, rel=0.05)
    assert found.amplitudes[0] == pytest.approx(FORCE_N, rel=0.02)


def test_frequency_of_a_line_is_found_from_an_inaccurate_guess() -> None:
    """Its phase turns with the frequency: derivatives must be those of the regressed amplitudes."""
    covered = replace(Extent.typical(PLACES), tones_hz=(LINE_HZ,))
    lines = (e for e in all_effects(PLACES, covered) if e.effect_class == "vibration")
    line = next(e for e in lines if e.where == ("z",) and len(e.shape) == 1)
    made = record("moving", 21_000)
    signals, _ = filtered(point(), made, motion(point().model, made.experiment, "zoh"))
    force = Placed(line, (LINE_HZ,), (0.03, -0.02)).term(signals).force
    assert force is not None
    shaken = with_motion(made, moved_by(force, made))
    duration_s = made.rows * TS
    guess = LINE_HZ - 0.6 / duration_s  # it is out of phase at one end
    begun = Tried(line, (guess,), 0.0, np.zeros(1), (0.01, 0.01))
    (found,) = with_fitted_shapes(point(), [begun], OneRecord(shaken))
    assert abs(found.shape[0] - LINE_HZ) < 0.02 / duration_s
    assert found.amplitudes == pytest.approx((0.03, -0.02), rel=0.05)


def test_no_shape_beside_the_found_one_explains_more(rubbing: TraceRecord) -> None:
    """A second method: the regression of the amplitude at shapes around it, without derivatives."""
    (found,) = with_fitted_shapes(point(), [started(COULOMB, 1e-3)], OneRecord(rubbing))
    shapes = [(found.shape[0] * factor,) for factor in (0.95, 1.0, 1.05)]
    candidates = [(EFFECTS[COULOMB], shape) for shape in shapes]
    train = gather(point(), OneRecord(rubbing).train(point(), tuple(candidates)))
    left = []
    for i in range(3):
        gram = train.joined(i).whole
        columns = list(range(len(gram) - 1))
        left.append(float(remaining(gram[None], columns, solve(gram, columns))[0]))
    assert left[1] < min(left[0], left[2])


def test_in_the_place_of_an_effect_it_comes_back(rubbing: TraceRecord) -> None:
    placed = Placed(EFFECTS[COULOMB], (SPEED_M_S,), (FORCE_N,))
    here = replace(point(), placed=(placed,))
    some = [started(COULOMB, 1e-3), started(DAHL, 1e-5)]
    found, other = with_fitted_shapes(here, some, OneRecord(rubbing), placed)
    assert found.shape[0] == pytest.approx(SPEED_M_S, rel=0.02)
    assert found.amplitudes[0] == pytest.approx(FORCE_N, rel=0.01)
    assert found.gain > other.gain


def test_many_are_fitted_in_the_passes_of_one(rubbing: TraceRecord) -> None:
    alone, together = OneRecord(rubbing), OneRecord(rubbing)
    single = with_fitted_shapes(point(), [started(COULOMB, 1e-3)], alone)
    some = [started(COULOMB, 1e-3), started(CUBIC), started(DAHL, 1e-5)]
    found = with_fitted_shapes(point(), some, together)
    assert [t.effect.identity for t in found] == [COULOMB, CUBIC, DAHL]
    assert found[0].shape == pytest.approx(single[0].shape, rel=1e-9)
    assert found[1].shape == ()
    assert found[0].gain > found[2].gain  # the right law takes more
    assert together.asked <= 11
    with_fitted_shapes(point(), [started(CUBIC)], (once := OneRecord(rubbing)))
    assert once.asked == 1  # nothing to fit but the amplitude


def test_amplitude_outside_its_bounds_stays_at_the_bound(rubbing: TraceRecord) -> None:
    placed = Placed(EFFECTS[COULOMB], (SPEED_M_S,), (3.0 * FORCE_N,))
    here = replace(point(), placed=(placed,))  # the errors ask for a friction that drives
    (found,) = with_fitted_shapes(here, [started(COULOMB, 1e-2)], OneRecord(rubbing))
    assert found.amplitudes == (0.0,)


def test_shape_that_cannot_be_computed_ends_its_own_fit_only(rubbing: TraceRecord) -> None:
    alone = with_fitted_shapes(point(), [started(COULOMB, 1e-3)], OneRecord(rubbing))
    good, bad = started(COULOMB, 1e-3), started(DAHL, 1e-5)

    def fails(signals, shape):
        raise np.linalg.LinAlgError("no such shape")

    def endless(signals, shape):
        return [Term(force=np.full((signals.rows, 3), np.nan))]

    raising = replace(bad, effect=replace(bad.effect, build=fails))
    undefined = replace(bad, effect=replace(bad.effect, build=endless))
    found = with_fitted_shapes(point(), [raising, good, undefined], OneRecord(rubbing))
    assert found[0] == raising
    assert found[1].shape == pytest.approx(alone[0].shape, rel=1e-9)
    assert found[2].gain == -np.inf
