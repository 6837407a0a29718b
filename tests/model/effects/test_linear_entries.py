"""Test the linear entries that a model may lack: as forces, and found in simulated records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from levid.benchmarks.trace.judged_plants import traced
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.docs.make_effects_table import rig_places, two_dof
from levid.identification.trace.force_regression.candidate_fit import Beside, taken_at
from levid.identification.trace.force_search import weighed_records
from levid.identification.trace.force_trace.trace_imported import ForceTrace
from levid.model.effects import linear_entries
from levid.model.effects.base import Effect, Signals

Array = NDArray[np.float64]

TS_S, ROWS = 2e-3, 3000
M, D, K = np.diag([2.0, 0.5]), np.diag([8.0, 3.0]), np.diag([1500.0, 900.0])
TWO = """
levid: model
name: two
dof: [{name: x, unit: m}, {name: r, unit: rad}]
inputs: [{name: f, unit: N}, {name: g, unit: N}]
parameters:
  m: {value: 2.3, unit: kg, min: 0}
  j: {value: 0.43, unit: kg m^2, min: 0}
  d: {value: 7.0, unit: N s/m, min: 0}
  e: {value: 3.4, unit: N m s/rad, min: 0}
  k: {value: 1300, unit: N/m, min: 0}
  c: {value: 1000, unit: N m/rad, min: 0}
M: [[m, 0], [0, j]]
D: [[d, 0], [0, e]]
K: [[k, 0], [0, c]]
B: [[1, 1], [0.2, -0.2]]
"""
ONE = """
levid: model
name: one
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
parameters:
  m: {value: 2.2, unit: kg, fixed: true}
  d: {value: 7.0, unit: N s/m, min: 0}
  k: {value: 1300, unit: N/m, min: 0}
M: [[m]]
D: [[d]]
K: [[k]]
"""


def flown(M: Array, D: Array, K: Array, B: Array, seed: int) -> tuple[Array, Array]:
    """Return held random commands (rows, p) and readings (rows, n) of a linear plant."""
    n, p = B.shape
    rng = np.random.default_rng(seed)
    inverse = np.linalg.inv(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ K, -inverse @ D]])
    whole = np.zeros((2 * n + p, 2 * n + p))
    whole[: 2 * n, : 2 * n], whole[n : 2 * n, 2 * n :] = A, inverse @ B
    step = expm(whole * TS_S)[: 2 * n]
    u = np.cumsum(rng.standard_normal((ROWS, p)), axis=0)
    u = u - np.array([np.convolve(c, np.ones(200) / 200.0, mode="same") for c in u.T]).T
    state, y = np.zeros(2 * n), np.zeros((ROWS, n))
    for k in range(ROWS):
        y[k] = state[:n]
        state = step @ np.concatenate([state, u[k]])
    return u, y + 1e-3 * y.std(axis=0) * rng.standard_normal(y.shape)


def found(text: str, M: Array, D: Array, K: Array, B: Array) -> ForceTrace:
    records = [flown(M, D, K, B, seed) for seed in (1, 2)]
    return traced(parse_text(text, ModelConfig, "model"), records, TS_S)


def named(trace: ForceTrace) -> list[set[str]]:
    """Return each effect with its alternatives, by identity."""
    return [
        {r.placed.effect.identity, *(a.placed.effect.identity for a in r.alternatives)}
        for r in trace.found.rated
    ]


def signals(seed: int) -> Signals:
    rng, places = np.random.default_rng(seed), two_dof()
    q, qd, qdd, u = rng.standard_normal((4, 50, 2))
    none = np.zeros(50)
    return Signals(
        TS_S, TS_S * np.arange(50), q, qd, qdd, u, none, none, none, none, none, none, 0, places
    )


def entry(key: str, where: Sequence[str]) -> Effect:
    return next(
        e
        for e in linear_entries.effects(two_dof())
        if e.key == f"linear.{key}" and e.where == tuple(where)
    )


@pytest.mark.parametrize(
    ("key", "where", "signal", "matrix"),
    [
        ("stiffness", ("q",), "q", [[1, 0], [0, 0]]),
        ("damping", ("q2",), "qd", [[0, 0], [0, 1]]),
        ("inertia", ("q",), "qdd", [[1, 0], [0, 0]]),
        ("stiffness_across", ("q", "q2"), "q", [[0, 1], [1, 0]]),
        ("inertia_across", ("q", "q2"), "qdd", [[0, 1], [1, 0]]),
        ("gyroscopic", ("q", "q2"), "qd", [[0, 1], [-1, 0]]),
    ],
)
def test_each_is_an_entry_of_a_matrix(
    key: str, where: Sequence[str], signal: str, matrix: list[list[float]]
) -> None:
    s = signals(1)
    (term,) = entry(key, where).build(s, ())
    np.testing.assert_allclose(term.force, -getattr(s, signal) @ np.array(matrix, float).T)


def test_a_gyroscopic_force_does_no_work() -> None:
    s = signals(2)
    (term,) = entry("gyroscopic", ("q", "q2")).build(s, ())
    assert term.force is not None
    np.testing.assert_allclose(np.sum(term.force * s.qd, axis=1), 0.0, atol=1e-14)


def test_a_command_acts_with_its_delay_in_the_middle_of_its_steps() -> None:
    t = np.arange(400.0)
    for delay in (0, 3):
        held = np.cos(0.3 * t)
        s = replace(
            signals(3), time_s=t, coil=np.column_stack([held, held]), delay_cycles=delay,
            q=np.zeros((400, 2)),
        )  # fmt: skip
        (term,) = entry("input", ("q2", "each actuator")).build(s, ())
        assert term.force is not None
        # The spectrum of a held command at this frequency: sinc, half a row later.
        expected = np.sinc(0.3 / (2.0 * np.pi)) * np.cos(0.3 * (t - 0.5 - delay))
        np.testing.assert_allclose(term.force[10:-10, 1], expected[10:-10], atol=2e-4)
        assert not term.force[:, 0].any()


def test_the_rig_declares_its_own() -> None:
    assert linear_entries.effects(rig_places()) == []


ACROSS = np.array([[0.0, 1.0], [1.0, 0.0]])
LEVERS = np.array([[1.0, 1.0], [0.2, -0.2]])


@pytest.mark.parametrize(
    ("key", "matrices", "value"),
    [
        ("linear.inertia_across@x+r", (M + 0.05 * ACROSS, D, K, LEVERS), 0.05),
        ("linear.stiffness_across@x+r", (M, D, K + 60.0 * ACROSS, LEVERS), 60.0),
    ],
)
def test_a_coupling_that_is_missing_is_found(
    key: str, matrices: tuple[Array, Array, Array, Array], value: float
) -> None:
    trace = found(TWO, *matrices)
    assert named(trace) == [{key}]
    (amplitude,) = trace.found.rated[0].placed.amplitudes
    assert amplitude == pytest.approx(value, abs=3.0 * trace.errors[-1])
    assert trace.errors[-1] < 0.02 * value


def test_a_wrong_lever_is_one_of_either_input() -> None:
    # The inertia about r is free: a longer lever of one input is a shorter one of the other.
    levers = LEVERS + np.array([[0.0, 0.0], [0.0, -0.03]])
    assert named(found(TWO, M, D, K, levers)) == [{"linear.input@r+f", "linear.input@r+g"}]


def test_a_wrong_fixed_mass_is_inertia_or_the_gain_of_the_input() -> None:
    one = (matrix[:1, :1] for matrix in (M, D, K))
    trace = found(ONE, *one, np.eye(1))
    assert named(trace) == [{"linear.inertia@x", "coil_gain@f", "reading.gain@x"}]


@pytest.mark.parametrize("scale", [1.0, 1e10])
def test_a_number_of_any_unit_has_an_error(scale: float) -> None:
    # A column for 1 N/m is nothing beside the force of a stage that moves by a tenth of 1 nm.
    text = ONE.replace("[[k]]", "[[0]]").replace(", fixed: true", ", min: 0")
    text = text.replace("2.2", f"{2.2 * scale:g}").replace("7.0", f"{7.0 * scale:g}")
    one = [scale * matrix[:1, :1] for matrix in (M, D, K)]
    trace = found(text, *one, np.eye(1))
    assert named(trace) == [{"linear.stiffness@x"}]
    (stiffness,) = trace.found.rated[0].placed.amplitudes
    assert stiffness == pytest.approx(scale * K[0, 0], rel=0.01)
    assert trace.errors[-1] < 0.01 * stiffness


def test_a_parameter_at_a_limit_of_its_range_gets_a_note() -> None:
    text = ONE.replace("value: 7.0, unit: N s/m, min: 0", "value: 7.0, unit: N s/m, max: 7.2")
    one = [matrix[:1, :1] for matrix in (M * 1.1, D, K)]
    notes = found(text, *one, np.eye(1)).notes
    assert any(
        n.startswith("d is at the upper limit of its range in the model file") for n in notes
    )


def test_a_lever_is_none_where_nothing_else_tells_the_scale_of_an_equation() -> None:
    # A gain of the only input of an equation of which all else is free makes all of it small.
    text = TWO.replace("[[1, 1], [0.2, -0.2]]", "[[1, 0], [0, 1]]")
    trace = found(text, M + 0.05 * ACROSS, D, K, np.eye(2))
    training, point, _ = weighed_records.unweighed(
        trace.declared, trace.fitted, trace.limit_hz, trace.options
    )
    beside, told = Beside.of(point, training), trace.options.told_from_model
    table = {e.identity: e for e in linear_entries.effects(trace.places)}

    def taken(where: str) -> float | None:
        return taken_at(beside, table[f"linear.input@{where}"], (), told)

    assert taken("x+f") is None
    assert taken("r+g") is None
    assert taken("x+g") is not None
    assert taken("r+f") is not None


def test_nothing_is_named_where_all_entries_are_declared() -> None:
    assert named(found(TWO, M, D, K, LEVERS)) == []
