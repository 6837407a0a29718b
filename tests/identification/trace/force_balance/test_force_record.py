"""Test the forces of effects in a record below a limit: they pass its low-pass once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.signal import lfilter

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.force_balance.band_limited_signals import BandLimited
from levid.identification.greybox.free_parameters import free_parameters
from levid.identification.trace.force_balance.force_record import ForceModel, ForceRecord
from levid.identification.trace.records.initial_guesses import extent
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.model.effects.base import Effect, Placed, Quantity, Signals, Term
from levid.model.effects.candidate_effects import all_effects

TS, ROWS, LIMIT_HZ = 0.002, 8000, 20.0
CONFIG = parse_text(
    """
levid: model
name: mass
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
parameters: {m: {value: 2.0, unit: kg, min: 0.1, max: 10}}
M: [[m]]
D: [[0]]
K: [[0]]
""",
    ModelConfig,
    "mass",
)

ALL_FREE = """
levid: model
name: mass
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
parameters:
  m: {value: 2.0, unit: kg, min: 0.1, max: 10}
  d: {value: 3.0, unit: N s/m, min: 0, max: 100}
  k: {value: 50.0, unit: N/m, min: 0, max: 1000}
  b: {value: 1.5, unit: "1", min: 0, max: 10}
  delay: {value: 0.004, unit: s, min: 0, max: 0.1}
M: [[m]]
D: [[d]]
K: [[k]]
B: [[b]]
delay_s: delay
"""


def record(law_hz: float) -> ForceRecord:
    """Return a record whose position has frequencies up to some 30 Hz."""
    y = lfilter([0.3], [1.0, -0.7], np.random.default_rng(4).normal(size=(ROWS, 1)), axis=0)
    e = Experiment("r", TS, np.zeros((ROWS, 1)), 1e-3 * y, {}, frozenset(), False)
    return ForceRecord.of(imported_trace_record(e, CONFIG), "zoh", LIMIT_HZ, law_hz, np.zeros(1))


def test_positions_are_not_filtered_where_all_frequencies_are_worth_their_noise() -> None:
    """At a quarter of the rate the low-pass would take 2 % of them, of which a law is no part."""
    y = np.random.default_rng(4).normal(size=(ROWS, 1))
    e = Experiment("r", TS, np.zeros((ROWS, 1)), y, {}, frozenset(), False)
    made = imported_trace_record(e, CONFIG)
    for sd, unfiltered in ((0.1, True), (1.0, False)):
        found = ForceRecord.of(made, "zoh", LIMIT_HZ, 50.0, np.array([sd]))
        assert np.array_equal(found.signals.q, y) == unfiltered


def damping(signals: Signals, _shape: Sequence[float]) -> list[Term]:
    return [Term(force=-signals.qd)]


def missing_share(law_hz: float, linear: bool = False) -> float:
    """Return the RMS difference of q' of the balance and the force of unit damping, over q'."""
    made = record(law_hz)
    effect = Effect("d", "Damping", "damping", ("x",), "", (Quantity("d", "N s/m"),), damping,
                    linear=linear)  # fmt: skip
    point = ForceModel(declared_model(CONFIG), free_parameters(CONFIG))
    (force,) = made.effect_forces(point, effect, ())
    speed = made.kept[1]
    return float(np.std(np.abs(force) - np.abs(speed)) / np.std(speed))


def test_force_that_is_linear_in_the_motion_is_that_of_the_balance() -> None:
    # What the wider low-pass takes, (20 / 200)^8 at the limit, is far less; but both continue the
    # record beyond its ends, and what is left of that differs.
    assert missing_share(200.0) < 2e-3
    # Of signals below the limit itself it would pass the low-pass twice.
    assert missing_share(LIMIT_HZ) > 0.02


def test_rows_of_a_dof_that_rests_count_where_asked() -> None:
    y = np.zeros((ROWS, 1))
    y[: ROWS // 2, 0] = 1e-3 * np.sin(np.arange(ROWS // 2) * TS * 2.0 * np.pi * 5.0)
    e = Experiment("r", TS, np.zeros((ROWS, 1)), y, {}, frozenset(), False)
    found = ForceRecord.of(imported_trace_record(e, CONFIG), "zoh", 20.0, 20.0, np.array([1e-6]))
    end = found.counted_from(3 * ROWS // 4)
    assert not end.moves.any()
    assert end.counted_at_rest(np.array([True])).moves.all()
    assert not end.counted_at_rest(np.array([False])).moves.any()


def test_a_linear_term_passes_the_low_pass_once_whatever_the_limit_of_laws_is() -> None:
    assert missing_share(LIMIT_HZ, linear=True) < 1e-9


def test_laws_see_positions_beyond_the_limit_of_velocities() -> None:
    """A step of the position is above its noise up to the Nyquist frequency, its speed is not."""
    sd, rng = 1e-5, np.random.default_rng(5)
    steps = np.repeat(rng.uniform(-0.01, 0.01, 40), 100)[:, None]
    true = lfilter([0.7], [1.0, -0.3], steps, axis=0)
    e = Experiment(
        "r", 0.02, steps, true + sd * rng.normal(size=true.shape), {}, frozenset(), False
    )
    made = ForceRecord.of(imported_trace_record(e, CONFIG), "zoh", 1.0, 2.5, np.array([sd]))
    narrow = BandLimited.of(e, "zoh", 2.5, 4.0).derivatives[0]
    assert np.std(made.signals.q - true) < 0.2 * np.std(narrow - true)


@pytest.mark.parametrize("name", ["m", "d", "k", "b", "delay"])
@pytest.mark.parametrize(
    "identity",
    ["friction.coulomb@x", "actuator.squared@f", "reading.quadratic@x", "actuator_lag@f"],
)
def test_change_is_the_difference_of_the_groups(name: str, identity: str) -> None:
    """An effect that acts by its force alone is left out, one by inputs or readings is not."""
    config = parse_text(ALL_FREE, ModelConfig, "mass")
    rng = np.random.default_rng(6)
    u, y = rng.standard_normal((2, 2000, 1))
    y = lfilter([0.1], [1.0, -0.9], y, axis=0)
    e = Experiment("r", TS, u, y, {}, frozenset(), False)
    own = imported_trace_record(e, config)
    made = ForceRecord.of(own, "zoh", LIMIT_HZ, 100.0, np.zeros(1))
    effect = next(e for e in all_effects(own.places, extent([own])) if e.identity == identity)
    shape = effect.grid[0] if effect.shape else ()
    placed = (Placed(effect, shape, tuple(1.0 for _ in effect.amplitudes)),)
    point = ForceModel(declared_model(config), free_parameters(config), placed)
    high = point.with_values(
        point.values + 0.1 * (np.array(point.parameters.names) == name) * point.values
    )
    expected = made.groups(high) - made.groups(point)
    assert np.any(expected)
    np.testing.assert_allclose(
        made.change(point, high), expected, atol=1e-12 * np.abs(made.groups(point)).max()
    )
