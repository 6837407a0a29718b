"""Test that a law which only keeps an output's noise out of an equation takes nothing there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from levid.benchmarks.trace.imported_plant_cases import declared
from levid.benchmarks.trace.imported_plant_effects import case
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.trace.force_balance.force_record import ForceModel
from levid.identification.trace.force_regression.gain_beyond_output_noise import (
    more_than_noise,
    taken_beyond_noise,
)
from levid.identification.trace.force_regression.gauss_newton_fit import fit_numbers
from levid.identification.trace.force_regression.training_records import Training
from levid.identification.trace.force_search import weighed_records
from levid.identification.trace.force_trace.trace_imported import trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.base import Effect, Placed, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

SEED, OPTIONS = 3, SearchOptions()


@dataclass(frozen=True)
class Geared:
    """Records of a motor that drives a load by a soft shaft and hits a stop, and models of them.

    Outputs are the angles of the motor and of the shaft's twist. declared, with_stop: their fits.
    """

    training: Training
    declared: ForceModel
    with_stop: ForceModel
    load: Effect

    def squares(self, point: ForceModel) -> float:
        """Return the squared missing force of the motor."""
        return float(self.training.at(point).squares[0])

    def taken(self, before: ForceModel, after: ForceModel) -> bool:
        return bool(taken_beyond_noise(before, after, self.training, OPTIONS)[0])


@pytest.fixture(scope="module")
def geared() -> Geared:
    drawn = case("geared", "stop", SEED)
    config, _ = declared(drawn.plant, np.random.default_rng(SEED), False)
    u, y = drawn.motion.u, drawn.motion.y
    record = Experiment("r", drawn.plant.Ts_s, u, y, {}, frozenset(), False, feedback=True)
    laws: dict[str, Effect] = {}

    def none_but_kept(places: Places, covered: Extent) -> list[Effect]:
        laws.update({e.identity: e for e in all_effects(places, covered)})
        return []

    records = [imported_trace_record(record, config)]
    trace = trace_records(records, config, none_but_kept, lambda *_: None)
    training, point, _ = weighed_records.unweighed(
        trace.declared, trace.fitted, trace.limit_hz, trace.options
    )
    training, point = weighed_records.weighed(training, point, (), trace.options)
    k, q0 = map(float, drawn.effects[0].numbers)
    stop = Placed(laws["stiffness.one_sided@motor"], (q0,), (k,))
    with_stop = fit_numbers(training, replace(point, placed=(stop,)))
    return Geared(training, point, with_stop, laws["flexible_mode.load@motor"])


def test_a_stop_takes_more_than_noise(geared: Geared) -> None:
    assert geared.squares(geared.with_stop) < 0.9 * geared.squares(geared.declared)
    assert geared.taken(geared.declared, geared.with_stop)


def test_a_load_in_the_place_of_the_one_that_is_measured_takes_noise_only(geared: Geared) -> None:
    """It moves as the motor makes it move: the noise of the twist is no part of that."""
    right = geared.with_stop
    values = dict(zip(right.parameters.names, right.values.tolist(), strict=True))
    j, rate = values["j_2"], np.sqrt(values["k_c"] / values["j_2"])
    numbers = rate / (2.0 * np.pi), 0.5 * values["d_c"] / (j * rate), values["d_2"] / j
    small = {name: 0.05 * values[name] for name in ("j_2", "d_2", "d_c", "k_c")}
    placed = (*right.placed, Placed(geared.load, numbers, (0.95 * j,)))
    instead = replace(right.with_values(np.array([*(values | small).values()])), placed=placed)
    assert geared.squares(instead) < 0.5 * geared.squares(right)
    assert not geared.taken(right, instead)


def test_noise_of_the_outputs_is_what_the_right_model_leaves(geared: Geared) -> None:
    point, training = geared.with_stop, geared.training
    noise = training.noise(point) * training.at(point).share ** 2
    # Four standard errors of the sum of 1700 independent squares of each DOF.
    np.testing.assert_allclose(noise, training.at(point).squares, rtol=0.15)


@pytest.mark.parametrize(
    ("squares", "noise", "more"),
    [
        ((100.0, 50.0), (1.0, 1.0), True),  # an effect that changes no noise
        ((100.0, 10.0), (100.0, 10.0), False),  # noise alone
        ((150.0, 15.0), (100.0, 10.0), False),  # half more of it than was measured
        ((1100.0, 1010.0), (100.0, 10.0), False),  # beside what another effect lacks
        ((2000.0, 1010.0), (100.0, 10.0), True),  # an effect beside it, and noise
        ((150.0, 10.0), (100.0, 10.0), True),  # an effect of half of the noise, and noise
    ],
)
def test_what_is_taken_is_compared_with_noise(
    squares: tuple[float, float], noise: tuple[float, float], more: bool
) -> None:
    values = np.array(squares)[:, None], np.array(noise)[:, None]
    assert more_than_noise(*values, OPTIONS)[0] == more
