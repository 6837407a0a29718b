"""Test the grey-box fit: exact inputs and filter, standard errors, unidentifiable parameters."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm

from levid.config.base import parse_text
from levid.config.model import ModelConfig, load_model
from levid.config.shipped import shipped
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.control_loop import ControlLoop
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.experiment.intersample_input import Hold, moments
from levid.identification.greybox.fit import fit_model
from levid.identification.greybox.free_run.free_run_simulation import free_run
from levid.identification.greybox.identify_greybox import identify_grey_box, to_yaml
from levid.identification.greybox.prediction.discretisation import innovations, motion
from levid.identification.greybox.prediction.noise_model import Noise, kalman_filter
from levid.identification.greybox.validation import whiteness
from levid.identification.records.record import IdentificationError
from levid.model.controller import pi_controller
from levid.model.declared_model import ModelError
from levid.model.second_order import SecondOrder, StateSpace, discretise

ONE_MASS = """
levid: model
name: mass
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
input: zoh
parameters:
  m: {value: 2.0, unit: kg, min: 0.1, max: 20}
  d: {value: 3.0, unit: N s/m, min: 0, max: 100}
  k: {value: 800.0, unit: N/m, min: 1, max: 10000}
  lag: {value: 0.002, unit: s, fixed: true}
M: [[m]]
D: [[d]]
K: [[k]]
lag_s: lag
"""
TS = 1e-3
NOISE = Noise.independent(np.array([1e-6]), np.array([1e-14]))


def one_mass(**values: object) -> ModelConfig:
    config = parse_text(ONE_MASS, ModelConfig, "mass")
    parameters = {
        name: p.model_copy(update={"value": values.get(name, p.value)})
        for name, p in config.parameters.items()
    }
    return config.model_copy(update={"parameters": parameters})


def record(
    seed: int, rows: int = 6000, config: ModelConfig | None = None, noise: float = 1.0
) -> Experiment:
    """Simulate the mass sample by sample with scipy's matrices, independent of the fit's code."""
    rng = np.random.default_rng(seed)
    model = declared_model(config or one_mass()).at()
    u = rng.standard_normal((rows, 1))
    sampled = discretise(replace(model, delay_s=model.delay_s + TS), TS)
    # White force noise of density S held over a period has the variance S / Ts.
    disturbed = discretise(replace(model, lag_s=0.0, delay_s=0.0), TS)
    w = rng.standard_normal((rows, 1)) * np.sqrt(NOISE.force_psd / TS) * noise
    x, z, y = np.zeros(len(sampled.A)), np.zeros(len(disturbed.A)), np.empty((rows, 1))
    for k in range(rows):
        y[k] = sampled.C @ x + disturbed.C @ z
        x, z = sampled.A @ x + sampled.B @ u[k], disturbed.A @ z + disturbed.B @ w[k]
    y += rng.standard_normal((rows, 1)) * np.sqrt(NOISE.output_variance) * noise
    return Experiment("made", TS, u, y, {}, frozenset(), False, 1)


@cache
def fits(count: int):
    start = one_mass(m=2.1, d=2.5, k=780.0)
    return [fit_model(start, [record(seed, 3000)]) for seed in range(count)]


def oscillator(omega: float, delay_s: float, lag_s: float) -> SecondOrder:
    one = np.ones((1, 1))
    return SecondOrder(one, 1.5 * one, omega**2 * one, one, np.zeros(1), lag_s, delay_s)


def step_with_moments(model: SecondOrder, parts: np.ndarray) -> np.ndarray:
    """Step q'' + 1.5 q' + omega^2 q = u with the moments of u in each period."""
    A = np.array([[0, 1], [-model.K[0, 0], -1.5]])
    B = np.array([[0], [1.0]])
    step = expm(A * TS)
    q, y = np.zeros(2), np.empty((len(parts), 1))
    for k in range(len(parts)):
        y[k] = q[0]
        power, q = B[:, 0], step @ q
        for part in parts[k, :, 0]:
            q = q + power * part
            power = A @ power
    return y


def step_state_space(model: StateSpace, u: np.ndarray) -> np.ndarray:
    x, y = np.zeros(len(model.A)), np.empty((len(u), 1))
    for k in range(len(u)):
        y[k] = model.C @ x + model.D @ u[k]
        x = model.A @ x + model.B @ u[k]
    return y


@pytest.mark.parametrize(("omega", "order"), [(20.0, 12), (628.0, 16), (2500.0, 30)])
@pytest.mark.parametrize("lag_s", [0.0, 3e-5, 3e-4, 5e-3, 0.1])
@pytest.mark.parametrize("delay_s", [0.0, 0.3e-3, 1e-3, 2.4e-3])
@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_moments_step_a_model_as_its_exact_discretisation_does(
    hold: Hold, delay_s: float, lag_s: float, omega: float, order: int
) -> None:
    model = oscillator(omega, delay_s, lag_s)
    u = np.random.default_rng(1).standard_normal((200, 1))
    u[:4] = 0.0
    expected = step_state_space(discretise(model, TS, hold), u)
    y = step_with_moments(model, moments(u, TS, order, hold, delay_s, lag_s))
    # Rounding of 200 steps; the series is long enough for omega Ts: 2.5^30 / 30! is 3e-21.
    np.testing.assert_allclose(y, expected, atol=2e-13 * np.abs(expected).max())


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_input_before_a_record_equals_its_first_row(hold: Hold) -> None:
    model = oscillator(20.0, 1.4e-3, 3e-4)
    u = 1.0 + np.cumsum(np.random.default_rng(1).standard_normal((200, 1)), axis=0)
    long = np.vstack([np.repeat(u[:1], 100, 0), u])  # 33 time constants: the start decays to 1e-14
    parts, all_parts = (moments(x, TS, 12, hold, model.delay_s, model.lag_s) for x in (u, long))
    size = np.abs(parts).max(axis=(0, 2), keepdims=True)
    np.testing.assert_allclose(parts / size, all_parts[100:] / size, atol=1e-13)


def test_band_limited_input_is_interpolated_between_samples() -> None:
    # A sampled sine below half the rate, reconstructed as band limited, acts like the sine.
    n, omega = 4000, 2 * np.pi * 120.0
    t = np.arange(n) * TS
    parts = moments(np.sin(omega * t)[:, None], TS, 3, "band_limited", 0.4e-3, 0.0)
    begin, end = t - 0.4e-3, t + TS - 0.4e-3
    exact = (np.cos(omega * begin) - np.cos(omega * end)) / omega
    middle = slice(500, n - 500)
    # Error of linear interpolation with eight points per period: (omega Ts / 8)^2 / 12.
    np.testing.assert_allclose(parts[middle, 0, 0], exact[middle], atol=1.2e-3 * TS)


def test_true_model_leaves_white_errors_of_unit_variance() -> None:
    e = record(3, 20_000)
    at = motion(declared_model(one_mass()), e, "zoh")
    kalman = kalman_filter(at, NOISE)
    errors = kalman.whiten(innovations(at, kalman.gain, e.y, np.zeros(2)))[200:]
    # The variance of n unit samples has the standard deviation sqrt(2 / n); four of these.
    assert abs(errors.var() - 1.0) < 4 * np.sqrt(2 / len(errors))
    assert whiteness(errors).p_value.min() > 1e-3


def test_whiteness_bound_holds_for_99_percent_of_white_records() -> None:
    found = whiteness(np.random.default_rng(11).normal(size=(2000, 1000)))
    share = np.mean(np.all(np.abs(found.correlation) < found.bound, axis=1))
    # Of 1000 records 10 +- 3 exceed the bound. A bound for each of the 25 lags alone would be
    # exceeded by 22 % of the records.
    assert 0.98 <= share < 1.0


def test_errors_of_parameters_scale_with_the_noise() -> None:
    quiet, loud = (record(1, 4000, noise=scale) for scale in (1e-3, 1.0))
    for name, value in {"m": 2.0, "d": 3.0, "k": 800.0}.items():
        one, other = (fit_model(one_mass(m=2.2, d=2.0, k=700.0), [e]) for e in (quiet, loud))
        # 1/1000 of the noise gives 1/1000 of the error and of the standard error.
        assert one.standard_errors[name] < 3e-3 * other.standard_errors[name]
        assert abs(one.values[name] - value) < 4 * one.standard_errors[name]


def test_confidence_intervals_have_95_percent_coverage() -> None:
    # 24 records, 3 parameters: 95 % intervals miss 3.6 of 72 on average; more than 10 misses have a
    # probability below 0.001.
    truth = {"m": 2.0, "d": 3.0, "k": 800.0}
    z = np.array(
        [[(f.values[n] - truth[n]) / f.standard_errors[n] for n in truth] for f in fits(24)]
    )
    assert np.count_nonzero(np.abs(z) > 1.96) <= 10
    # The spread agrees with the standard errors: chi-square of 72 within its 99.9 % interval.
    assert 0.65 < np.sqrt(np.mean(z**2)) < 1.35


def test_noise_is_estimated_with_the_parameters() -> None:
    found = np.array([[f.noise.force_psd[0], f.noise.output_variance[0]] for f in fits(24)])
    # 3000 rows determine each variance to about 5 %, 24 records their mean to 1 %; ten times that.
    np.testing.assert_allclose(found.mean(axis=0), [1e-6, 1e-14], rtol=0.1)


def test_unidentifiable_parameter_is_held_and_reported() -> None:
    text = ONE_MASS.replace("M: [[m]]", "M: [[m + m2]]").replace(
        "  lag:", "  m2: {value: 0.5, unit: kg, min: 0, max: 5}\n  lag:"
    )
    config = parse_text(text.replace("value: 2.0", "value: 1.5"), ModelConfig, "two masses")
    fit = fit_model(config, [record(1)])
    assert len(fit.unidentifiable) == 1
    (lost,) = fit.unidentifiable
    assert {lost.name, *lost.together_with} == {"m", "m2"}
    assert "cannot be identified apart from" in str(lost)
    assert fit.values[lost.name] == config.parameters[lost.name].value
    assert fit.values["m"] + fit.values["m2"] == pytest.approx(2.0, rel=1e-3)


def test_prior_makes_a_parameter_identifiable() -> None:
    text = ONE_MASS.replace("M: [[m]]", "M: [[m + m2]]").replace(
        "  lag:", "  m2: {value: 0.5, unit: kg, min: 0, max: 5, prior_sd: 0.01}\n  lag:"
    )
    fit = fit_model(parse_text(text, ModelConfig, "two masses"), [record(1)])
    assert not fit.unidentifiable
    assert fit.values["m2"] == pytest.approx(0.5, abs=0.01)
    assert fit.standard_errors["m2"] == pytest.approx(0.01, rel=0.05)


def test_mass_is_unidentifiable_with_slow_excitation() -> None:
    # Lines up to 0.33 Hz, far below the resonance at 3.2 Hz: the mass changes the output by 1 % of
    # 50 um, a tenth of the noise; 6000 rows determine the stiffness to a few percent at best.
    rng, t = np.random.default_rng(2), np.arange(6000) * TS
    u = 0.04 * (np.sin(2 * np.pi * t / 6) + np.cos(2 * np.pi * t / 3))[:, None]
    y = u / 800.0 + 3e-4 * rng.standard_normal((6000, 1))
    damped = one_mass(d=30.0)
    known = {**damped.parameters, "d": damped.parameters["d"].model_copy(update={"fixed": True})}
    fit = fit_model(damped.model_copy(update={"parameters": known}), [replace(record(1), u=u, y=y)])
    assert [lost.name for lost in fit.unidentifiable] == ["m"]
    assert fit.values["m"] == 2.0
    assert abs(fit.values["k"] - 800.0) < 4 * fit.standard_errors["k"]


def test_parameter_at_its_bound_is_reported() -> None:
    config = one_mass()
    bounded = config.parameters["k"].model_copy(update={"max": 790.0, "value": 780.0})
    fit = fit_model(
        config.model_copy(update={"parameters": {**config.parameters, "k": bounded}}), [record(1)]
    )
    assert fit.values["k"] == 790.0
    assert "k" in fit.at_bound


def test_equal_bounds_fix_a_parameter() -> None:
    config = one_mass()
    shut = config.parameters["d"].model_copy(update={"min": 3.0, "max": 3.0})
    fit = fit_model(
        config.model_copy(update={"parameters": {**config.parameters, "d": shut}}), [record(1)]
    )
    assert fit.values["d"] == 3.0
    assert fit.free == ("m", "k")
    assert not fit.at_bound
    assert abs(fit.values["k"] - 800.0) < 4 * fit.standard_errors["k"]


def test_singular_mass_is_reported_with_record_or_schedule_value() -> None:
    config = parse_text(ONE_MASS.replace("M: [[m]]", "M: [[m - 2]]"), ModelConfig, "mass")
    with pytest.raises(
        IdentificationError,
        match=r"'mass': record 'made': M: expected .* inverse, found \[\[0\.0\]\]",
    ):
        fit_model(config, [record(1)])
    moved = parse_text(
        ONE_MASS.replace("M: [[m]]", "M: [[m * x]]") + "scheduling: {x: {unit: m, signal: x}}\n",
        ModelConfig,
        "mass",
    )
    schedule = {"x": np.arange(6000) - 1234.5}  # in the middle of period 1234 it is 0
    along = replace(record(1), schedule=schedule, moving=True)
    with pytest.raises(ModelError, match=r"at x = 0$"):
        motion(declared_model(moved), along, "zoh")


def test_closed_loop_free_run_needs_the_excitation_only() -> None:
    # The data come from an explicit loop; the kernel simulates from v alone.
    config, model = one_mass(), declared_model(one_mass())
    kp, ki = np.array([200.0]), np.array([500.0])
    rows, rng = 12_000, np.random.default_rng(5)
    v = rng.standard_normal((rows, 1))
    v[:200] = 0.0
    sampled = discretise(replace(model.at(), delay_s=TS), TS)
    x, integral = np.zeros(len(sampled.A)), np.zeros(1)
    y, u = np.empty((rows, 1)), np.empty((rows, 1))
    for k in range(rows):
        y[k] = sampled.C @ x
        integral = integral - ki * TS * y[k]
        u[k] = v[k] - kp * y[k] + integral
        x = sampled.A @ x + sampled.B @ u[k]
    zero = np.zeros((rows, 1))
    loop = ControlLoop(v, zero, zero, zero, pi_controller(kp, ki, TS))
    e = Experiment("loop", TS, u, y, {}, frozenset(), False, 1, loop)
    run = free_run(declared_model(config), e, "zoh", NOISE)
    error = np.abs(run.y - y)[run.counts_from :].max()
    assert error < 1e-6 * np.abs(y).max()
    np.testing.assert_allclose(run.u[run.counts_from :], u[run.counts_from :], atol=1e-4)


def test_fitted_model_round_trips_through_a_model_file() -> None:
    grey = identify_grey_box(one_mass(m=2.1), [record(1)], 0.25)
    again = parse_text(to_yaml(grey.fitted), ModelConfig, "model.yaml")
    assert again == grey.fitted
    assert again.parameters["m"].se == pytest.approx(grey.fit.standard_errors["m"])
    assert again.parameters["lag"].se is None
    # The simulation error of the held-out data is at the noise floor.
    (check,) = grey.validations
    assert check.error_rms[0] < (1 + 4 * check.floor_spread[0]) * check.floor_rms[0]
    assert to_yaml(load_model(shipped("models/rig.yaml"))).startswith("levid: model")


def test_model_file_always_contains_the_input_hold() -> None:
    """A reader with another default must still use the same input hold."""
    for hold, text in (("zoh", ONE_MASS.replace("input: zoh\n", "")), ("foh", ONE_MASS)):
        config = parse_text(text.replace("zoh", hold), ModelConfig, "mass")
        written = to_yaml(config)
        assert f"\ninput: {hold}\n" in written
        assert parse_text(written, ModelConfig, "again") == config


def test_input_hold_that_contradicts_the_model_gives_a_remark() -> None:
    contradicting = replace(record(1), hold="band_limited")
    agreeing = replace(record(1), name="agreeing", hold="zoh")
    grey = identify_grey_box(one_mass(m=2.1), [contradicting, agreeing, record(1)], 0.0)
    (remark,) = grey.remarks
    assert remark.startswith("record 'made': input_hold: band_limited")
    assert "input: zoh in model 'mass'" in remark


def test_closed_loop_record_needs_a_zoh_model() -> None:
    zero = np.zeros((6000, 1))
    loop = ControlLoop(zero, zero, zero, zero, pi_controller(np.ones(1), np.ones(1), TS))
    with pytest.raises(IdentificationError, match="input: expected zoh, found"):
        identify_grey_box(
            one_mass().model_copy(update={"input": "foh"}), [replace(record(1), loop=loop)], 0.0
        )


@pytest.mark.parametrize("hold", ["zoh", "foh", "band_limited"])
def test_response_includes_plant_and_input_hold(hold: Hold) -> None:
    # Fitted with a zero-order hold; only the response for these values is tested.
    config = one_mass().model_copy(update={"input": hold})
    grey = replace(identify_grey_box(one_mass(), [record(1)], 0.0), declared=config)
    freq = np.array([1.0, 3.2, 50.0, 400.0])
    m, d, k, lag = (grey.fit.model.values[name] for name in ("m", "d", "k", "lag"))
    response = np.zeros(4, complex)
    for alias in range(-2000, 2001) if hold != "band_limited" else (0,):
        s = 2j * np.pi * (freq + alias / TS)
        held = (1 - np.exp(-s * TS)) / (s * TS)
        shape = {"zoh": held, "foh": held**2 * np.exp(s * TS), "band_limited": 1.0}[hold]
        response += shape * np.exp(-s * TS) / (1 + s * lag) / (m * s**2 + d * s + k)
    # The error of leaving out further aliases falls with the fourth power of 2000.
    np.testing.assert_allclose(grey.response({}, freq)[:, 0, 0], response, rtol=1e-8)


def test_no_records_and_short_records_are_rejected() -> None:
    with pytest.raises(IdentificationError, match="at least one record"):
        fit_model(one_mass(), [])
    with pytest.raises(IdentificationError, match="at least 50 rows, found 20"):
        fit_model(one_mass(), [record(1).rows(0, 20)])


def mass_and_record(Ts_s: float, rows: int) -> tuple[ModelConfig, Experiment]:
    """Return a mass with a period of 20 rows, and a record of it."""
    omega = 0.3 / Ts_s
    text = ONE_MASS.replace("value: 3.0", f"value: {0.4 * omega}").replace("lag_s: lag\n", "")
    config = parse_text(
        text.replace("value: 800.0", f"value: {2 * omega**2}").replace("min: 1,", "min: 1.0e-6,"),
        ModelConfig,
        "slow",
    )
    u = np.random.default_rng(1).standard_normal((rows, 1))
    y = step_state_space(discretise(declared_model(config).at(), Ts_s), u)
    y += 0.01 * y.std() * np.random.default_rng(2).standard_normal(y.shape)
    return config, Experiment("slow", Ts_s, u, y, {}, frozenset(), False)


@pytest.mark.parametrize("rows", [100, 600])
def test_validation_is_independent_of_the_sampling_time(rows: int) -> None:
    made = mass_and_record(0.1, rows), mass_and_record(60.0, rows)
    quick, minutes = (identify_grey_box(c, [e], 0.25).validations[0] for c, e in made)
    # In units of the sampling time both records are equal.
    assert len(minutes.measured) == len(quick.measured)
    np.testing.assert_allclose(minutes.fit_percent, quick.fit_percent, rtol=1e-3)
    np.testing.assert_allclose(minutes.freq_hz * 600, quick.freq_hz, rtol=1e-12)
    np.testing.assert_allclose(minutes.whiteness.p_value, quick.whiteness.p_value, rtol=1e-2)
    assert minutes.whiteness.p_value[0] > 1e-3
    assert minutes.fit_percent[0] > 90


def test_record_too_short_for_an_initial_state_is_rejected() -> None:
    with pytest.raises(IdentificationError, match=r"record 'made': expected at least 9 rows .* 8"):
        free_run(declared_model(one_mass()), record(1).rows(0, 8), "zoh", NOISE)
