"""Test the checks before a fit: each finds its fault, and a good record has no remark."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.checks_before_fit import check_before_fit
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.control_loop import ControlLoop
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.options import Options
from levid.identification.records.record import Record
from levid.model.controller import pi_controller
from levid.model.second_order import discretise

TS, ROWS = 0.01, 4000
MODEL = """
levid: model
name: spring
dof: [{name: q, unit: m}]
inputs: [{name: f, unit: N}]
parameters:
  m: {value: 2.0, unit: kg, min: 0.1, max: 20}
  d: {value: 3.0, unit: N s/m, min: 0.01, max: 100}
  k: {value: 50.0, unit: N/m, min: 0.1, max: 1000}
M: [[m]]
D: [[d]]
K: [[k]]
"""
TWICE = MODEL.replace("K: [[k]]", "K: [[k]]\nB: [[a * b]]").replace(
    "M: [[m]]",
    "  a: {value: 1.0, unit: N/V, min: 0.1, max: 10}\n"
    "  b: {value: 1.0, unit: '1', min: 0.1, max: 10}\nM: [[2.0]]",
)
FREE = MODEL.replace("K: [[k]]", "K: [[0.0]]")


def model(text: str = MODEL) -> ModelConfig:
    return parse_text(text, ModelConfig, "model")


def fixed(text: str, name: str) -> ModelConfig:
    return model(text.replace(f"{name}: {{", f"{name}: {{fixed: true, "))


def white(rows: int = ROWS, inputs: int = 1, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(rows, inputs))


def experiment(config: ModelConfig, u: np.ndarray | None = None, Ts_s: float = TS) -> Experiment:
    u = white() if u is None else u
    plant = discretise(declared_model(config).at(), Ts_s)
    x, y = np.zeros(len(plant.A)), np.empty((len(u), 1))
    for k in range(len(u)):
        y[k] = plant.C @ x
        x = plant.A @ x + plant.B @ u[k]
    y += 1e-3 * y.std() * white(len(u), seed=2)
    return Experiment("r", Ts_s, u, y, {}, frozenset(), moving=False)


def record(v: np.ndarray, **changes: object) -> Record:
    y = sum(lfilter([0.0, 1.0], [1.0, -0.5], column) for column in v.T)[:, None]
    names = tuple("abcd"[: v.shape[1]])
    return replace(
        Record("r", TS, v, y, names, ("N",) * len(names), ("y",), ("m",)),
        **changes,  # type: ignore[arg-type]
    )


def of_model(config: ModelConfig, *experiments: Experiment) -> tuple[str, ...]:
    return check_before_fit((), experiments, config, Options())


def of_record(*records: Record, **options: int) -> tuple[str, ...]:
    return check_before_fit(records, (), None, Options(**options))


def test_good_record_and_model_have_no_remark() -> None:
    config = model()
    assert check_before_fit([record(white())], [experiment(config)], config, Options()) == ()
    assert of_record(record(white(inputs=3))) == ()


@pytest.mark.parametrize("input_", ["sweep", "low-pass noise", "square wave"])
def test_usual_excitations_have_no_remark(input_: str) -> None:
    t = np.arange(ROWS) * TS
    v = {
        "sweep": np.sin(2 * np.pi * (0.1 + 0.25 * t) * t),
        "low-pass noise": lfilter([1.0], [1.0, -0.95], white()[:, 0]),
        "square wave": np.sign(white(40)[:, 0]).repeat(100),
    }[input_]
    assert of_record(record(v[:, None])) == ()


def test_constant_input_is_named() -> None:
    v = white(inputs=2)
    v[:3000, 1] = 0.7  # varies in the held-out rows only
    (remark,) = of_record(record(v))
    assert remark.startswith("input b is constant in all rows that the fit uses")
    assert of_record(record(v), record(white(inputs=2))) == ()


def test_inputs_that_depend_on_each_other_are_named_with_their_combination() -> None:
    v = white(inputs=3)
    v[:, 2] = 2.0 * v[:, 0] - 0.5 * v[:, 1] + 4.0
    (remark,) = of_record(record(v))
    assert remark.startswith("input c depends on the other inputs: c = 2 a + -0.5 b + constant")
    v[:, 2] += 0.1 * v[:, 2].std() * white(seed=3)[:, 0]  # 1 % of its power
    assert of_record(record(v)) == ()


def test_input_of_few_sine_waves_is_reported() -> None:
    t = np.arange(ROWS) * TS
    v = np.sin(2 * np.pi * 1.234 * t) + np.sin(2 * np.pi * 7.1 * t)
    (remark,) = of_record(record(v[:, None]))
    assert remark.startswith("input a consists of 2 sine waves (99.9 % of its power)")
    assert "above order 2 fits noise" in remark
    assert of_record(record(v[:, None]), order=2) == ()


def test_few_rows_for_the_black_box_are_reported() -> None:
    # 10 (3 n + 1) values give order 4 in 150 training rows, 20 in 610.
    (remark,) = of_record(record(white(200)))
    assert "150 rows" in remark
    assert "only up to order 4:" in remark
    assert of_record(record(white(200)), order=4) == ()
    assert of_record(record(white(814))) == ()
    (given,) = of_record(record(white(200)), order=6)
    assert given.endswith("or choose --order 4")


def test_few_rows_for_the_parameters_are_reported() -> None:
    # 3 parameters, 3 unknowns of the record and 2 noises: 80 values.
    config = model()
    assert not any(
        "free numbers" in text for text in of_model(config, experiment(config, white(108)))
    )
    (remark,) = (t for t in of_model(config, experiment(config, white(100))) if "free numbers" in t)
    assert "9.4 values for each of 8 free numbers (3 parameters" in remark
    assert "at least 80 rows" in remark


def test_clipped_signals_of_a_record_are_reported_before_the_fit() -> None:
    found = of_record(record(white(), remarks=("a rests at its highest value, 1 N",)))
    assert found == ("record 'r': a rests at its highest value, 1 N",)


def test_integrating_and_unstable_models_without_a_loop_are_reported() -> None:
    config = fixed(FREE, "k")
    (remark,) = of_model(config, experiment(config))
    assert remark.startswith("record 'r': the declared model integrates at its start values")
    assert "key loop" in remark
    in_loop = replace(experiment(config), feedback=True)  # by an unknown controller
    assert of_model(config, in_loop) == ()
    unstable = model(MODEL.replace("value: 50.0", "value: -2.0").replace("min: 0.1", "min: -9"))
    (remark,) = of_model(unstable, experiment(config))
    # 2 s^2 + 3 s - 2 = 0 at s = 0.5
    assert "is unstable at its start values, with a pole of real part +0.5 1/s" in remark


def test_time_constant_longer_than_the_record_is_reported() -> None:
    # d / k = 12 s; the fit uses 30 s, and 10 s are held out.
    config = model(MODEL.replace("value: 3.0", "value: 60.0").replace("value: 50.0", "value: 5.0"))
    no_loop, slow = of_model(config, experiment(config))
    assert "has a time constant of 12 s at its start values, longer than the 10 s" in no_loop
    assert "last 2.5 time constants of the model's slowest mode (12 s" in slow
    assert "Record at least 47.9 s" in slow
    assert of_model(config, experiment(config, white(2 * ROWS))) == ()


@pytest.mark.parametrize(("gain", "reported"), [(100.0, False), (-100.0, True)])
def test_controller_that_does_not_stabilise_the_model_is_reported(
    gain: float, reported: bool
) -> None:
    config = model()
    e = experiment(config)
    zero = np.zeros_like(e.u)
    pi = pi_controller(np.array([gain]), np.array([0.0]), TS)
    found = of_model(config, replace(e, loop=ControlLoop(e.u, zero, zero, zero, pi), feedback=True))
    assert any("does not stabilise the declared model" in text for text in found) == reported
    if reported:
        # 2 s^2 + 3 s + 50 - 100 = 0 at s = 4.3; the held input shifts it by 2 %.
        assert "a pole of real part +4.2" in found[0] or "+4.3" in found[0]


def test_parameters_that_occur_only_as_a_product_are_reported() -> None:
    text = TWICE.replace("m: {", "m: {fixed: true, ")
    config = model(text)
    (remark,) = of_model(config, experiment(config))
    assert "the records do not determine a apart from b" in remark or "b apart from a" in remark
    assert "(fixed: true)" in remark
    assert of_model(fixed(text, "b"), experiment(config)) == ()


def test_parameter_without_effect_on_the_outputs_is_reported() -> None:
    # The record lasts 1e-3 time constants of the spring.
    config = model(
        MODEL.replace("value: 50.0", "value: 1e-4").replace("min: 0.1, max: 1000", "min: 0")
    )
    (remark,) = (t for t in of_model(config, experiment(config)) if "do not determine" in t)
    assert (
        "the records do not determine k: sensitivities at its start values give a standard error"
        in remark
    )
