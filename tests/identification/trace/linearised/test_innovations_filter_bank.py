"""Test regression columns of a record: each equals the change of the prediction errors.

The records are simulated with the rig's declared model in open loop; a still or moving beam gives
a fixed or moving schedule.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from declared_model_records import (
    CONFIG,
    NOISE,
    PLACES,
    SENSOR_SD,
    SHAPE,
    TS,
    point,
    record,
    smooth,
)

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.free_parameters import free_parameters
from levid.identification.greybox.prediction.discretisation import innovations, motion
from levid.identification.greybox.prediction.noise_model import Noise, kalman_filter
from levid.identification.greybox.prediction.prediction_errors import predict, settled
from levid.identification.trace.linearised import linearise_prediction_errors as linearised
from levid.identification.trace.linearised.drive_force_residual import beside_motion
from levid.identification.trace.linearised.innovations_filter_bank import (
    FilterBank,
    thinned,
    transitions,
)
from levid.identification.trace.linearised.linearisation_point import (
    WorkingPoint,
    along,
    corrected_experiment,
    filtered,
)
from levid.identification.trace.linearised.linearise_prediction_errors import (
    effect_terms,
    linearise,
    parameter_columns,
    redundancy_basis,
)
from levid.identification.trace.records.record_from_log import TraceRecord
from levid.identification.trace.records.sensor_and_amplifier_noise import Disturbance
from levid.identification.trace.search.regression import ColumnEvidence
from levid.model.effects.base import Effect, Placed, Quantity, Term, on_coil, on_dof
from levid.model.effects.candidate_effects import all_effects

KINDS = ("fixed", "moving")


def bank_of(record: TraceRecord, every: int = 1) -> FilterBank:
    here = point()
    at = motion(here.model, record.experiment, "zoh")
    kalman = kalman_filter(at, NOISE)
    return FilterBank.build(here.model, record, at, kalman, "zoh", every)


def whitened(record: TraceRecord, added: Term) -> np.ndarray:
    """Return the prediction errors of the fit's filter if the model includes the term."""
    here = point()
    at = motion(here.model, record.experiment, "zoh")
    kalman = kalman_filter(at, NOISE)
    e, at = corrected_experiment(here, record, at, added)
    errors = kalman.whiten(innovations(at, kalman.gain, e.y, np.zeros(6)))
    errors[: at.blind] = 0.0
    return errors


def terms(record: TraceRecord) -> dict[str, Term]:
    rng = np.random.default_rng(5)
    rows = record.rows
    return {
        "held": Term(held=rng.normal(size=(rows, 3))),  # commands may jump
        "force": Term(force=smooth(rng, rows, 3, 60.0)),
        "gap": Term(gap=1e-5 * rng.normal(size=(rows, 9))),
    }


@pytest.mark.parametrize("kind", KINDS)
def test_transition_of_every_period_is_the_matrix_exponential(kind: str) -> None:
    from scipy.linalg import expm

    at = motion(declared_model(CONFIG), record(kind).experiment, "zoh")
    Phi = transitions(at)
    for row in range(0, len(Phi), 700):
        # The series is accurate to 1e-12 of the state, with speeds scaled to the size of positions.
        scale = np.diag([1.0] * 3 + [TS] * 3)
        A, _ = at.continuous(row)
        exact = scale @ expm(A * TS) @ np.linalg.inv(scale)
        np.testing.assert_allclose(scale @ Phi[row] @ np.linalg.inv(scale), exact, atol=1e-11)


@pytest.mark.parametrize("what", ["held", "force", "gap"])
@pytest.mark.parametrize("kind", KINDS)
def test_column_equals_the_change_of_filter_errors_by_the_term(kind: str, what: str) -> None:
    made = record(kind)
    term = terms(made)[what]
    column = bank_of(made).columns([term], 1)[:, :, 0]
    # A column is the change of the errors by a unit of the effect in the model; it has the opposite
    # sign of the change by the same force on the plant.
    change = whitened(made, term) - whitened(made, Term())
    size = np.abs(change).max()
    # On a moving schedule the column uses one damping per period. The error is half the change of
    # the damping in a period: 2 m_b v_b / (J or m) times Ts.
    tolerance = 1e-9 if kind == "fixed" or what == "gap" else 1e-3
    assert np.abs(column - change).max() < tolerance * size


def test_columns_do_not_depend_on_their_neighbours() -> None:
    made = record("fixed", 1200)
    some = list(terms(made).values())
    bank = bank_of(made, 4)
    many = bank.columns([*some * 7, Term()], 22)  # more than one batch
    np.testing.assert_array_equal(many[:, :, 21], 0.0)
    for i in range(21):
        alone = bank.columns([some[i % 3]], 1)[:, :, 0]
        # Rounding: the sums are in another order.
        np.testing.assert_allclose(many[:, :, i], alone, atol=1e-10 * np.abs(alone).max())


def test_columns_of_constant_forces_equal_those_of_the_prediction() -> None:
    made = record("moving", 1500)
    here = point()
    kalman = kalman_filter(motion(here.model, made.experiment, "zoh"), NOISE)
    expected = predict(here.model, made.experiment, "zoh", kalman).unknowns[:, :, :3]
    found = bank_of(made).constants()
    size = np.abs(expected).max(axis=(0, 1))
    # As above: one damping per period.
    assert np.max(np.abs(found - expected) / size) < 1e-3


def test_constant_force_of_a_candidate_has_no_column() -> None:
    """A dead zone below every command is a constant force, which is fitted for each record."""
    made, newton = record("moving", 1500), 5.0
    quantity = Quantity("width", "N")
    dead = Effect(
        "d", "d", "d", ("coil:1",), "", (quantity,),
        lambda s, _: [on_coil(s, 1, np.full(s.rows, newton))],
    )  # fmt: skip
    grown = Effect(
        "g", "g", "g", ("coil:1",), "", (quantity,),
        lambda s, _: [on_coil(s, 1, newton * np.sin(6.0 * s.time_s))],
    )  # fmt: skip
    there = linearise(point(), made, [(dead, ()), (grown, ())])
    idle, active = (float(np.trace(b.inner.sum(axis=0)) * b.size[0] ** 2) for b in there.beside)
    # Its first row, before the delayed command acts, is forgotten by the filter.
    assert idle < 1e-9 * active


@pytest.mark.parametrize("kind", KINDS)
def test_initial_force_of_known_friction_is_projected_out(kind: str) -> None:
    """With known hysteretic friction, a force that decays with slip is its initial state."""
    made, break_away = record(kind, 1500), 5e-5

    def dahl(x: np.ndarray, f: float) -> np.ndarray:
        forces = []
        for dx in np.diff(x, prepend=x[0]) / break_away:
            end = 1.0 if dx > 0 else -1.0
            f = end + (f - end) * np.exp(-abs(dx))
            forces.append(f)
        return np.array(forces)

    began = Effect(
        "b", "b", "b", ("z",), "", (Quantity("f", "N"),),
        lambda s, _: [on_dof(s, 2, dahl(s.q[:, 2], 0.9) - dahl(s.q[:, 2], -0.4))],
    )  # fmt: skip
    friction = next(e for e in all_effects(PLACES) if e.identity == "friction.dahl@z")
    known = replace(point(), placed=(Placed(friction, (break_away,), (0.0,)),))
    free, taken = (
        float(np.trace(b.inner.sum(axis=0)) * b.size[0] ** 2)
        for there in (point(), known)
        for b in linearise(there, made, [(began, ())]).beside
    )
    # Rounding: both have the same column.
    assert taken < 1e-9 * free


@pytest.mark.parametrize("kind", KINDS)
def test_parameter_columns_are_finite_differences_of_the_errors(kind: str) -> None:
    made, here = record(kind), point()
    at = motion(here.model, made.experiment, "zoh")
    kalman = kalman_filter(at, NOISE)
    start = predict(here.model, made.experiment, "zoh", kalman).start
    signals, _ = filtered(here, made, at)
    columns = parameter_columns(here, bank_of(made), signals)

    def errors(name: str, by: float) -> np.ndarray:
        model = here.model.with_values({name: here.model.values[name] + by})
        moved = motion(model, made.experiment, "zoh")
        found = kalman.whiten(innovations(moved, kalman.gain, made.experiment.y, start))
        found[: at.blind] = 0.0
        return found

    bank = bank_of(made)
    started = bank.errors(np.zeros((6, made.rows, 6)), None, np.eye(6))
    unknowns = np.concatenate([bank.constants(), started], axis=2).reshape(-1, 9)
    basis, _ = np.linalg.qr(unknowns / np.linalg.norm(unknowns, axis=0))

    def free(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(-1)
        return flat - basis @ (basis.T @ flat)

    worst = {}
    for i, (name, scale) in enumerate(
        zip(here.parameters.names, here.parameters.scale, strict=True)
    ):
        by = 1e-4 * scale
        low = errors(name, 0.0 if name == "delay" else -by)  # a delay may not turn negative here
        difference = (errors(name, by) - low) / (by if name == "delay" else 2 * by) * scale
        own, expected = free(columns[:, :, i]), free(difference)
        worst[name] = np.linalg.norm(own - expected) / np.linalg.norm(expected)
    # Columns use noisy readings (0.1 um of about 100) instead of filtered ones, and fourth-order
    # differences for accelerations: about 1 % at most.
    assert max(worst.values()) < 0.03, worst
    # These use exact commands; on a moving schedule a period has the stiffness and damping of row 0
    # (FilterBank.held_forcing).
    assert max(worst["lag"], worst["delay"]) < 0.002, worst


@pytest.mark.parametrize("key", ["friction.stribeck", "rod_stiffness.cubic"])
def test_columns_of_shape_parameters_are_finite_differences_of_the_terms(key: str) -> None:
    made = record("fixed")
    here = point()
    s, _ = filtered(here, made, motion(here.model, made.experiment, "zoh"))
    effect = next(e for e in all_effects(PLACES) if e.key == key and e.where == ("z",))
    placed = Placed(effect, effect.grid[0], (2.0,) * len(effect.amplitudes))
    found = effect_terms(placed, s)
    assert len(found) == len(effect.amplitudes) + len(effect.shape)
    for i, value in enumerate(effect.grid[0]):

        def force(by: float, i: int = i) -> np.ndarray:
            shape = list(effect.grid[0])
            shape[i] += by
            moved = placed.with_values(shape, placed.amplitudes).term(s).force
            assert moved is not None
            return moved

        by = 1e-5 * value
        expected = (force(by) - force(-by)) / (2 * by)
        column = found[len(effect.amplitudes) + i].force
        # Central differences with a relative step of 1e-5 have errors of second order.
        np.testing.assert_allclose(column, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("rows", [3000, 21_000])
def test_gram_matrices_of_blocks_sum_to_that_of_the_record(rows: int) -> None:
    made, here = record("fixed", rows), point()
    found = linearise(here, made, [])
    near = along(here, made)
    # Offset and start were fitted to single rows; fit them again to means of four rows.
    unknowns = near.unknowns.reshape(-1, 9)
    flat = near.errors.reshape(-1)
    flat = flat - unknowns @ np.linalg.lstsq(unknowns, flat, rcond=1e-14)[0]
    pose = float(np.sum(flat**2))
    beyond = made.gap @ redundancy_basis(SHAPE) / SENSOR_SD
    total = pose + float(np.sum(thinned(beyond, near.every) ** 2))
    # Rounding; the unknowns are ill-conditioned.
    assert found.gram[:, -1, -1].sum() == pytest.approx(total, rel=1e-7)
    # There are no pose errors before the first command acts.
    assert found.count.sum() == rows // near.every * 9 - 3 * near.at.blind / near.every
    assert len(found.gram) == max(round(rows * TS / 4.0), 1)
    for gram in found.gram:  # each is a Gram matrix
        np.testing.assert_allclose(gram, gram.T, atol=1e-12 * np.abs(gram).max())
        assert np.linalg.eigvalsh(gram).min() > -1e-9 * np.linalg.norm(gram)


def test_true_model_leaves_errors_of_unit_variance_per_sensor() -> None:
    # Nine errors per row: three of the pose, six non-rigid. The record has no force noise, so pose
    # errors are below one; the six are sensor noise.
    made = record("fixed", 21_000)
    found = linearise(point(), made, [])
    rows = found.count.sum() / 9
    squares = found.gram[:, -1, -1].sum() - np.sum(along(point(), made).errors ** 2)
    # A chi-square sum with 6 values per row: four standard deviations.
    assert squares / (6 * rows) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (6 * rows)))


def test_thinned_white_errors_keep_unit_variance() -> None:
    errors = np.random.default_rng(1).normal(size=(40_003, 2))
    found = thinned(errors, 4)
    assert found.shape == (10_000, 2)
    assert found.var() == pytest.approx(1.0, abs=4 * np.sqrt(2 / found.size))


def test_accepted_effects_are_included_in_the_prediction_errors() -> None:
    # An effect and its negative cancel.
    made, here = record("fixed"), point()
    s, _ = filtered(here, made, motion(here.model, made.experiment, "zoh"))
    cubic = next(e for e in all_effects(PLACES) if e.key == "rod_stiffness.cubic")
    force = on_dof(s, 0, -1e3 * s.q[:, 0] ** 3).force
    one = Placed(cubic, (), (1e3,))
    np.testing.assert_allclose(one.term(s).force, force, rtol=1e-12, atol=1e-300)
    two = replace(here, placed=(one, replace(one, amplitudes=(-1e3,))))
    np.testing.assert_allclose(
        along(two, made).errors,
        along(here, made).errors,
        atol=1e-6 * np.abs(along(here, made).errors).max(),
    )


def test_accepted_effects_are_included_in_the_accelerations_for_the_drives() -> None:
    # A weaker coil equals a smaller command. Otherwise the missing acceleration of the platform
    # would be taken for a force of the drives, and then for cogging.
    made, here = record("fixed"), point()
    s, _ = filtered(here, made, motion(here.model, made.experiment, "zoh"))
    gain = next(e for e in all_effects(PLACES) if e.identity == "coil_gain@coil:3")
    weak = Placed(gain, (), (-0.2,))
    smaller_command = replace(made.experiment, u=made.experiment.u + weak.term(s).held)
    less = along(here, replace(made, experiment=smaller_command))
    drive = np.random.default_rng(1).standard_normal(made.rows)
    residual = [
        beside_motion(at, drive) for at in (along(replace(here, placed=(weak,)), made), less)
    ]
    assert np.ptp(residual[0] - beside_motion(along(here, made), drive)) > 1e-3 * np.ptp(drive)
    np.testing.assert_allclose(residual[0], residual[1], atol=1e-6 * np.ptp(drive))


UNDERACTUATED = """
levid: model
name: two masses, one force on both
dof: [{name: q1, unit: m}, {name: q2, unit: m}]
inputs: [{name: f_n, unit: N}]
parameters:
  b1: {value: 1.0, unit: "1", min: 0, max: 5}
M: [[2.0, 0.0], [0.0, 1.0]]
D: [[10.0, 0.0], [0.0, 20.0]]
K: [[900.0, 0.0], [0.0, 400.0]]
B: [[b1], [2.0]]
"""


def test_column_of_an_input_matrix_entry_with_fewer_inputs_than_dof() -> None:
    # With fewer inputs than DOF, a change of one entry of B equals no change of the command.
    config = parse_text(UNDERACTUATED, ModelConfig, "two masses")
    one = np.eye(2)
    places = replace(
        PLACES, dof=("q1", "q2"), dof_units=("m", "m"), coil_shape=np.ones((1, 1)),
        sensor_shape=one, input_units=("N",), coil_xy_m=np.zeros((0, 2)),
        sensor_xy_m=np.zeros((0, 2)), beam=False,
    )  # fmt: skip
    rows = 3000
    u = smooth(np.random.default_rng(2), rows, 1, 20.0)
    e = Experiment("one force", TS, u, np.zeros((rows, 2)), {}, frozenset(), False, 1, hold="zoh")
    none = np.zeros((rows, 3))
    made = TraceRecord(
        e, places, np.arange(rows) * TS, e.y, u, np.zeros_like(u), none, none, None, "made"
    )
    known = Disturbance(
        Noise.independent(np.full(2, 1e-10), np.full(2, 1e-14)), SENSOR_SD, measured=True
    )

    def at(b1: float) -> WorkingPoint:
        model = declared_model(config).with_values({"b1": b1})
        return WorkingPoint(model, free_parameters(config), (), known, "zoh")

    def errors(b1: float) -> np.ndarray:
        there = at(b1)
        moved = motion(there.model, e, "zoh")
        kalman = kalman_filter(motion(at(1.0).model, e, "zoh"), known.noise)
        return kalman.whiten(innovations(moved, kalman.gain, e.y, np.zeros(4)))

    here = at(1.0)
    still = motion(here.model, e, "zoh")
    bank = FilterBank.build(here.model, made, still, kalman_filter(still, known.noise), "zoh", 1)
    s, _ = filtered(here, made, still)
    (column,) = np.moveaxis(parameter_columns(here, bank, s), 2, 0)
    expected = (errors(1.0 + 1e-4) - errors(1.0 - 1e-4)) / 2e-4 * here.parameters.scale[0]
    np.testing.assert_allclose(column[100:], expected[100:], atol=1e-3 * np.abs(expected).max())


def test_columns_of_long_records_are_computed_in_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    some = [(e, e.grid[0]) for e in all_effects(PLACES)[:40]]
    whole = linearise(point(), record("fixed"), some)
    monkeypatch.setattr(linearised, "_MAX_NUMBERS", 3 * 3000 // 4 * 7)  # seven columns per batch
    parts = linearise(point(), record("fixed"), some)
    np.testing.assert_allclose(parts.gram, whole.gram, rtol=1e-9, atol=1e-9)
    assert len(parts.beside) == len(whole.beside)
    for one, other in zip(parts.beside, whole.beside, strict=True):
        # Sums of other shapes round differently.
        np.testing.assert_allclose(one.inner, other.inner, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(one.cross, other.cross, rtol=1e-9, atol=1e-9)


def test_external_forces_on_the_beam_are_not_attributed_to_drive_friction() -> None:
    # A cable force depends on position, an imbalance on the rotor angle: both are external.
    made, here = record("fixed"), point()
    t = np.arange(made.rows) * made.experiment.Ts_s
    sweeping = np.column_stack([0.05 * np.sin(t), 0.05 * np.cos(t), -0.05 * np.sin(t)])
    turning = np.column_stack([20 * t, np.full_like(t, 20.0), np.zeros_like(t)])
    at = along(here, replace(made, beam=sweeping, rotor=turning))
    pull = 20.0 * sweeping[:, 0] + 3.0 * sweeping[:, 0] ** 2 + 0.4 * np.cos(20 * t)
    assert np.abs(beside_motion(at, pull)).max() < 1e-6 * np.ptp(pull)


def test_every_drive_effect_is_observable_in_the_drive_force() -> None:
    # The amplitude of an effect that is projected out would be arbitrary.
    made, here = record("fixed"), point()
    t = np.arange(made.rows) * made.experiment.Ts_s
    place, w = 0.05 * np.sin(7 * t), 7.0
    sweeping = np.column_stack([place, 0.35 * np.cos(w * t), -w * w * place])
    at = along(here, replace(made, beam=sweeping))
    for effect in all_effects(PLACES):
        for term in effect.build(at.signals, effect.grid[0]) if "beam" in effect.where else ():
            if term.drive is not None and np.ptp(term.drive) > 0:
                residual = beside_motion(at, term.drive)
                assert np.std(residual) > 1e-3 * np.std(term.drive), effect.identity


def test_drive_force_of_unknown_noise_does_not_change_the_excess() -> None:
    # Its noise is coloured, so its rows must not count as errors above the noise.
    made, here = record("moving"), point()
    shaken = np.convolve(np.random.default_rng(2).standard_normal(made.rows), np.ones(40), "same")
    excess = [
        ColumnEvidence.gather(
            [linearise(here, replace(made, drive_n=drive), ())], np.zeros((0, 1))
        ).excess
        for drive in (None, shaken)
    ]
    assert excess[1] == pytest.approx(excess[0], abs=1e-6 * made.rows)


def test_response_to_the_initial_state_equals_that_of_the_fit() -> None:
    made = record("fixed", 1500)
    here = point()
    at = motion(here.model, made.experiment, "zoh")
    kalman = kalman_filter(at, NOISE)
    start = np.array([1e-4, -1e-4, 2e-4, 0.01, 0.0, 0.02])
    silent = settled(replace(at, inputs=np.zeros_like(at.inputs)), np.zeros(3))
    expected = kalman.whiten(innovations(silent, kalman.gain, np.zeros((1500, 3)), start))
    expected[: at.blind] = 0.0
    found = bank_of(made).errors(np.zeros((1, 1500, 6)), None, start[:, None])[:, :, 0]
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_initial_force_of_a_free_form_is_projected_out() -> None:
    rng = np.random.default_rng(0)
    basis, _ = np.linalg.qr(rng.standard_normal((300, 2)))
    held = rng.standard_normal((100, 3, 2))
    remembers = SimpleNamespace(
        amplitudes=(1, 2, 3), effect_class="unknown", initial_force_decay=lambda *_: [None, None]
    )
    forgets = SimpleNamespace(amplitudes=(1,), effect_class="unknown", initial_force_decay=None)
    friction = SimpleNamespace(
        amplitudes=(1,), effect_class="friction", initial_force_decay=lambda *_: [None]
    )
    bank = SimpleNamespace(columns=lambda terms, count: held[:, :, :count])
    columns = rng.standard_normal((300, 5))
    columns -= basis @ (basis.T @ columns)
    before = columns.copy()
    candidates = [(forgets, ()), (remembers, ()), (friction, ())]
    linearised._project_out_memory(columns, SimpleNamespace(signals=None), bank, basis, candidates)
    np.testing.assert_array_equal(columns[:, [0, 4]], before[:, [0, 4]])
    both = np.hstack([basis, held.reshape(300, 2)])
    expected = before - both @ np.linalg.lstsq(both, before, rcond=None)[0]
    np.testing.assert_allclose(columns[:, 1:4], expected[:, 1:4], atol=1e-12)


def test_column_of_a_zero_lag_is_the_one_sided_derivative() -> None:
    made = record("fixed")
    (name,) = point().model.lag.names
    here = point(**{name: 0.0})
    at = motion(here.model, made.experiment, "zoh")
    kalman = kalman_filter(at, NOISE)
    bank = FilterBank.build(here.model, made, at, kalman, "zoh", 1)
    signals, _ = filtered(here, made, at)
    index = here.parameters.names.index(name)
    assert here.parameters.low[index] == 0.0
    column = parameter_columns(here, bank, signals)[:, :, index]

    def errors(lag_s: float) -> np.ndarray:
        moved = motion(point(**{name: lag_s}).model, made.experiment, "zoh")
        return kalman.whiten(innovations(moved, kalman.gain, made.experiment.y, np.zeros(6)))

    scale = here.parameters.scale[index]
    expected = (errors(1e-5 * scale) - errors(0.0)) / 1e-5
    np.testing.assert_allclose(column[100:], expected[100:], atol=1e-2 * np.abs(expected).max())
