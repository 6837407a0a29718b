"""Test the trace of imported records of plants whose laws are known, simulated by plain loops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.records.record import IdentificationError
from levid.identification.trace.force_checks.simpler_laws import with_simpler_laws
from levid.identification.trace.force_regression.training_records import Training
from levid.identification.trace.force_search.search import Searched
from levid.identification.trace.force_trace import trace_imported
from levid.identification.trace.force_trace.force_trace_summary import force_summary
from levid.identification.trace.force_trace.model_with_effects import (
    declared_effects,
    model_with_effects,
)
from levid.identification.trace.force_trace.trace_imported import ForceTrace, trace_records
from levid.identification.trace.records.record_from_log import imported_trace_record
from levid.identification.trace.search_options import SearchOptions
from levid.model.effects.base import Effect, Places
from levid.model.effects.candidate_effects import all_effects
from levid.model.effects.operating_range import Extent

Array = np.ndarray
Table = Callable[[Places, Extent], list[Effect]]

PENDULUM = """
levid: model
name: pendulum
dof: [{name: q, unit: rad}]
inputs: [{name: u, unit: V}]
parameters:
  j: {value: 0.12, unit: kg m^2, min: 0.001, max: 10}
  d: {value: 0.03, unit: N m s/rad, min: 0, max: 10}
  k: {value: 0.8, unit: N m/rad, min: 0, max: 100}
  b: {value: 0.3, unit: N m/V, fixed: true}
M: [[j]]
D: [[d]]
K: [[k]]
B: [[b]]
"""
DRIVE = """
levid: model
name: drive
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
parameters:
  m: {value: 8, unit: kg, min: 0.1, max: 100}
  d: {value: 20, unit: N s/m, min: 0, max: 1000}
M: [[m]]
D: [[d]]
K: [[0]]
"""


def simulated(
    acceleration: Callable[[float, float, float], float],
    command: Callable[[int, float], float],
    rows: int,
    Ts_s: float,
    steps: int = 20,
) -> tuple[Array, Array]:
    """Return held commands and positions (rows, 1), by the midpoint rule in `steps` a row."""
    q = v = 0.0
    u, y = np.zeros((rows, 1)), np.zeros((rows, 1))
    h = Ts_s / steps
    for k in range(rows):
        y[k] = q
        u[k] = command(k, q)
        for _ in range(steps):
            half = v + 0.5 * h * acceleration(q, v, u[k, 0])
            v += h * acceleration(q + 0.5 * h * v, half, u[k, 0])
            q += h * half
    return u, y


def smooth(rng: np.random.Generator, rows: int, width: int) -> Array:
    """Return noise below about 1 / (3 width rows), of unit variance."""
    x = rng.normal(size=rows + 2 * width)
    for _ in range(2):
        x = np.convolve(x, np.ones(width) / width, mode="valid")
    return x[:rows] / x[:rows].std() if len(x) >= rows else np.resize(x, rows) / x.std()


def pendulum(seed: int, linear: bool) -> Experiment:
    """Return an open-loop record of j q'' + d q' + k sin q = b u, or with k q."""
    rng = np.random.default_rng(seed)
    j, d, k, b = 0.1, 0.05, 1.0, 0.3
    u = smooth(rng, 6000, 40) * (0.6 if linear else 2.2)

    def acceleration(q: float, v: float, force: float) -> float:
        return (b * force - d * v - k * (q if linear else np.sin(q))) / j

    held, y = simulated(acceleration, lambda i, _: float(u[i]), 6000, 0.01)
    y += 1e-3 * rng.normal(size=y.shape)
    return Experiment("p", 0.01, held, y, {}, frozenset(), False)


def drive(seed: int, friction_n: float, peak_n: float = 0.0) -> Experiment:
    """Return a record of m x'' + d x' + friction sign(x') = f in an unknown PD loop.

    At rest the friction is larger by `peak_n`, up to some 0.02 m/s.
    """
    rng = np.random.default_rng(seed)
    rows, m, d = 8000, 10.0, 30.0
    reference, dither = 0.02 * smooth(rng, rows, 120), smooth(rng, rows, 15)
    last = [0.0]

    def command(k: int, q: float) -> float:
        seen = q + 1e-6 * rng.normal()
        rate, last[0] = (seen - last[0]) / 0.002, seen
        return float(9000.0 * (reference[k] - seen) - 250.0 * rate + 10.0 * dither[k])

    def acceleration(_q: float, v: float, force: float) -> float:
        friction = friction_n + peak_n * np.exp(-((v / 0.02) ** 2))
        return (force - d * v - friction * np.tanh(v / 1e-3)) / m

    f, y = simulated(acceleration, command, rows, 0.002)
    y += 1e-6 * rng.normal(size=y.shape)
    return Experiment("d", 0.002, f, y, {}, frozenset(), False, feedback=True)


def traced(model: str, *experiments: Experiment, table: Table = all_effects) -> ForceTrace:
    config = parse_text(model, ModelConfig, "model")
    records = [imported_trace_record(e, config) for e in experiments]
    return trace_records(records, config, table, lambda *_: None)


@pytest.mark.parametrize("seed", [1, 2])
def test_gravity_is_found_on_a_pendulum(seed: int):
    found = force_summary(traced(PENDULUM, pendulum(seed, linear=False)))
    (law,) = found["effects"]
    assert (law["class"], law["where"]) == ("gravity", ["q"])
    assert law["parameters"]["k_s"]["unit"] == "N m"
    force = found["validation"]["force_percent"]
    assert force["after"] < 0.2 * force["before"]


def test_nothing_is_named_on_a_linear_pendulum():
    found = traced(PENDULUM, pendulum(3, linear=True))
    result = force_summary(found)
    assert result["effects"] == []
    assert "no effect is confirmed" in result["unexplained"]["found"]
    assert result["validation"]["metric"] == "free_run"
    assert result["validation"]["noise_floor"] is None  # no record tells noise from misfit
    fitted = model_with_effects(found).parameters
    for name, true in (("j", 0.1), ("d", 0.05), ("k", 1.0)):
        assert fitted[name].se is not None
        assert abs(fitted[name].value - true) < 4.0 * fitted[name].se  # one in 16,000


def test_stated_noise_gives_a_floor_that_a_true_model_reaches():
    stated = replace(pendulum(3, linear=True), noise_sd=np.array([1e-3]))
    validation = force_summary(traced(PENDULUM, stated))["validation"]
    # In open loop the noise of the output alone moves nothing: one standard deviation.
    assert validation["noise_floor"] == pytest.approx(1.0, rel=1e-3)
    # 1500 rows scatter by 2 %; the fitted model adds as much.
    assert validation["after"] == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("seed", [1, 2])
def test_friction_is_found_in_an_unknown_loop(seed: int):
    found = force_summary(traced(DRIVE, drive(seed, 8.0)))
    (law,) = found["effects"]
    assert (law["class"], law["where"]) == ("friction", ["x"])
    assert found["validation"]["metric"] == "force"
    assert law["parameters"]["friction"]["unit"] == "N"
    assert law["parameters"]["friction"]["value"] == pytest.approx(8.0, rel=0.1)
    assert law["support"] > 0.9


def test_declared_friction_of_half_the_size_is_kept_and_refitted():
    declared = """
effects:
  - effect: friction.coulomb
    where: [x]
    parameters: {friction: {value: 4, unit: N}, v_s: {value: 0.002, unit: m/s}}
"""
    found = traced(DRIVE + declared, drive(1, 8.0))
    assert force_summary(found)["effects"] == []
    ((effect, parameters),) = declared_effects(found)
    assert effect.key == "friction.coulomb"
    assert parameters["friction"].value == pytest.approx(8.0, rel=0.1)
    assert found.found.dropped == ()


@pytest.mark.parametrize(("peak_n", "law"), [(0.0, "coulomb"), (6.0, "stribeck")])
def test_richer_law_stays_only_if_the_records_confirm_it_beside_the_simpler(
    peak_n: float, law: str, monkeypatch: pytest.MonkeyPatch
):
    """The search knows the richer law only, so that it takes it in both cases."""
    whole: dict[str, Effect] = {}
    keys: list[str] = []

    def only_stribeck(places: Places, extent: Extent) -> list[Effect]:
        whole.update({e.key: e for e in all_effects(places, extent)})
        return [whole["friction.stribeck"]]

    def from_all(found: Searched, _: object, training: Training, options: SearchOptions):
        keys.append(found.rated[0].placed.effect.key)
        return with_simpler_laws(found, list(whole.values()), training, options)

    monkeypatch.setattr(trace_imported, "with_simpler_laws", from_all)
    (one,) = traced(DRIVE, drive(2, 8.0, peak_n), table=only_stribeck).found.rated
    assert keys[0] == "friction.stribeck"
    assert one.placed.effect.key == f"friction.{law}"
    assert one.placed.amplitudes[0] == pytest.approx(8.0, rel=0.15)


def test_nothing_is_named_on_a_drive_without_friction():
    found = force_summary(traced(DRIVE, drive(4, 0.0)))
    assert found["effects"] == []
    assert found["validation"]["force_percent"]["after"] < 2.0


def test_gain_of_the_only_actuator_is_never_named():
    """With all masses free, a gain of -1 would lower every force to zero."""
    found = traced(DRIVE, drive(1, 8.0))
    classes = {r.placed.effect.effect_class for r in (*found.found.rated, *found.found.nearest)}
    assert "coil_gain" not in classes


def test_two_short_records_are_enough():
    halves = [pendulum(5, linear=False).rows(a, a + 2500) for a in (0, 3000)]
    (law,) = force_summary(traced(PENDULUM, *halves))["effects"]
    # 50 s may not tell sin q from q^3, but then it says so.
    assert "gravity" in (law["class"], *(a["class"] for a in law["alternatives"]))
    assert law["class"] in ("gravity", "ambiguous")


def test_records_without_motion_or_input_are_refused_with_what_to_do():
    rng = np.random.default_rng(1)
    noise, still = rng.normal(size=(3000, 1)), np.zeros((3000, 1))
    white = Experiment("w", 0.01, noise, rng.normal(size=(3000, 1)), {}, frozenset(), False)
    with pytest.raises(IdentificationError, match="found x within the noise in every record"):
        traced(DRIVE, white)
    constant = Experiment("c", 0.01, still, np.cumsum(noise, axis=0), {}, frozenset(), False)
    with pytest.raises(IdentificationError, match="expected an input that varies, found f const"):
        traced(DRIVE, constant)


def test_a_motion_that_is_too_slow_for_its_record_is_refused_with_what_to_do():
    t, rng = np.arange(3000) * 0.01, np.random.default_rng(1)
    slow = np.sin(2.0 * np.pi * 0.05 * t)[:, None]
    y = slow + 0.3 * rng.normal(size=slow.shape)
    record = Experiment("s", 0.01, slow, y, {}, frozenset(), False)
    with pytest.raises(IdentificationError, match=r"expected at least 16 independent values.*Hz"):
        traced(DRIVE, record)


def test_too_few_rows_are_refused_with_the_number():
    with pytest.raises(IdentificationError, match=r"expected at least 200 rows.*found 150"):
        traced(PENDULUM, pendulum(1, linear=True).rows(0, 150))
