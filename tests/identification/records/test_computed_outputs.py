"""Test that columns computed from others are told from measurements."""

from __future__ import annotations

import numpy as np
import pytest

from levid.benchmarks.harness.loops_under_noise import Loop
from levid.identification.nonparametric.records_without_a_model import why_no_model
from levid.identification.records.computed_outputs import computed_outputs
from levid.identification.records.record import Record

ROWS = 300
RNG = np.random.default_rng(3)
U = RNG.normal(size=(ROWS, 2))


def record(u: np.ndarray, y: np.ndarray) -> Record:
    p, m = u.shape[1], y.shape[1]
    return Record(
        "r", 0.01, u, y, ("f_n", "g_n")[:p], ("N",) * p, ("x_m", "y_m", "z_m")[:m], ("m",) * m
    )


def measured(seed: int) -> np.ndarray:
    return Loop(sensor=1e-6).record(ROWS, seed, given=U[:, 0]).y[:, 0]


def test_a_plant_is_no_copy() -> None:
    """Its readings have noise of a thousandth of the motion only."""
    one = record(U, np.stack([measured(1), measured(2)], 1))
    assert computed_outputs([one]) == ()
    assert why_no_model([one]) == ()


@pytest.mark.parametrize("factor", [1.0, -3.0, 1e-20])
def test_a_column_that_stands_twice_gives_no_model(factor: float) -> None:
    one = record(U, np.stack([factor * U[:, 0] + 2.0 * factor, measured(1)], 1))
    (found,) = computed_outputs([one])
    assert (found.name, found.of_inputs) == ("x_m", True)
    assert found.factors == {"f_n": pytest.approx(factor)}
    (reason,) = why_no_model([one])
    assert reason.startswith(f"output x_m is {factor:.3g} f_n + constant in every row")


def test_a_sum_of_outputs_is_named_and_gives_a_model() -> None:
    a, b = measured(1), measured(2)
    one = record(U, np.stack([a, b, 2.0 * a - b], 1))
    (found,) = computed_outputs([one])
    assert found.factors == {"x_m": pytest.approx(2.0), "y_m": pytest.approx(-1.0)}
    assert why_no_model([one]) == ()


def test_an_input_that_a_controller_computes_gives_no_model() -> None:
    """A proportional controller, and nothing that excites its loop."""
    loop = Loop(ki=0.0).record(ROWS, 1)
    (reason,) = why_no_model([loop])
    assert "a controller computes an input from outputs" in reason
    assert why_no_model([Loop(ki=0.0).record(ROWS, 1, excitation=U[:, 0])]) == ()


def test_records_of_several_rates_are_tested_apart() -> None:
    """A black-box model cannot be of both, so the reason is told beside the fitted model."""
    right, copied = record(U[:, :1], measured(1)[:, None]), record(U[:, :1], U[:, :1])
    slower = Record(
        "s", 0.02, copied.v, copied.y, ("f_n",), ("N",), ("x_m",), ("m",)
    )  # fmt: skip
    assert len(why_no_model([right, slower])) == 1
