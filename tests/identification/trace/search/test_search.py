"""Test the search for effects in logs: one undeclared effect is found, and no false one.

The plant is a mass on a spring, integrated here; its records are imported from CSV.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
from mass_on_spring_logs import imported

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.records.record import IdentificationError
from levid.identification.trace import run_trace
from levid.identification.trace.figure_data import views
from levid.identification.trace.linearised.linearise_prediction_errors import linearise
from levid.identification.trace.records.read_records import read_records
from levid.identification.trace.residual.free_run_error import pooled, record_error
from levid.identification.trace.run_trace import Trace, trace
from levid.identification.trace.worker_pool import Alone, RecordSource, Workers, local_workers
from levid.model.effects.candidate_effects import all_effects

MODEL = """
levid: model
name: mass
dof: [{name: x_m, unit: m}]
inputs: [{name: f_n, unit: N}]
input: band_limited
parameters:
  m: {value: 2.2, unit: kg, min: 0.1, max: 20}
  d: {value: 10.0, unit: N s/m, min: 0, max: 100}
  k: {value: 700.0, unit: N/m, min: 1, max: 10000}
M: [[m]]
D: [[d]]
K: [[k]]
"""
MASS, DAMPER, SPRING = 2.0, 12.0, 800.0
TS, ROWS, FINE = 4e-3, 4000, 10
SENSOR_SD, FORCE_PSD = 2e-7, 1e-8
RMS_N = (1.0, 3.0, 2.0, 4.0)
"""Excitation of each record."""
CONFIG = parse_text(MODEL, ModelConfig, "mass")
TRUTH = {"none": {}, "cubic": {"k3": 1e6}, "coulomb": {"friction": 0.1}}


def flown(
    seed: int, rms_n: float, k3: float = 0.0, friction: float = 0.0, clip_n: float = np.inf
) -> np.ndarray:
    """Return force and reading (N, 2) of the mass, by ten Runge-Kutta steps per row."""
    rng = np.random.default_rng(seed)
    omega, phase = 2 * np.pi * rng.uniform(0.3, 15.0, 30), rng.uniform(0, 2 * np.pi, 30)
    half = np.arange(2 * FINE * ROWS + 1) * (0.5 * TS / FINE)
    force = np.zeros_like(half)
    for w, p in zip(omega, phase, strict=True):
        force += rms_n / np.sqrt(15) * np.sin(w * half + p)
    # White force noise held for a row: its density is the variance times Ts.
    unknown = np.repeat(rng.normal(0.0, np.sqrt(FORCE_PSD / TS), ROWS), 2 * FINE)
    acting = np.clip(force, -clip_n, clip_n) + np.append(unknown, 0.0)
    u, acting_list = force[:: 2 * FINE], acting.tolist()
    x, step = [0.0, 0.0], TS / FINE
    y = np.empty(ROWS)

    def rate(q: float, v: float, f: float) -> float:
        slip = friction * np.tanh(v / 3e-3) if friction else 0.0
        return (f - DAMPER * v - SPRING * q - k3 * q * q * q - slip) / MASS

    for k in range(ROWS):
        y[k] = x[0]
        for i in range(FINE):
            at = 2 * (k * FINE + i)
            f0, f1, f2 = acting_list[at : at + 3]
            q, v = x
            a = rate(q, v, f0)
            b = rate(q + step / 2 * v, v + step / 2 * a, f1)
            c = rate(q + step / 2 * v + step**2 / 4 * a, v + step / 2 * b, f1)
            d = rate(q + step * v + step**2 / 2 * b, v + step * c, f2)
            x = [
                q + step * v + step**2 / 6 * (a + b + c),
                v + step / 6 * (a + 2 * b + 2 * c + d),
            ]
    return np.stack([u[:ROWS], y + rng.normal(0.0, SENSOR_SD, ROWS)], axis=1)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Path]]:
    """Return logs of three plants: as declared, with a hardening spring, with friction."""
    folder = tmp_path_factory.mktemp("trace")
    return {
        name: [
            imported(folder, f"{name}-{i}", flown(i, rms_n, **effect))
            for i, rms_n in enumerate(RMS_N)
        ]
        for name, effect in TRUTH.items()
    }


def traced(logs: list[Path], config: ModelConfig = CONFIG) -> Trace:
    return trace(logs, config, all_effects, Alone(config), lambda *_: None)


def test_a_search_without_time_says_what_it_has(logs: dict[str, list[Path]]) -> None:
    found = trace(logs["cubic"], CONFIG, all_effects, Alone(CONFIG), lambda *_: None, most_s=0.0)
    assert found.found.point.placed == ()
    assert any("the search ended after 0 min" in note for note in found.notes)


@pytest.mark.parametrize(
    ("steps", "confirmed"), [(3, ()), (20, ()), (80, ("Cubic stiffness at x_m",))]
)
def test_a_search_that_is_out_of_time_ends_with_what_it_had(
    logs: dict[str, list[Path]],
    monkeypatch: pytest.MonkeyPatch,
    steps: int,
    confirmed: tuple[str, ...],
) -> None:
    asked = 0

    def clock() -> float:
        nonlocal asked
        asked += 1
        return 0.0 if asked <= steps else 1e9

    monkeypatch.setattr(run_trace, "perf_counter", clock)
    found = traced(logs["cubic"])
    assert tuple(p.effect.name for p in found.found.point.placed) == confirmed
    assert any("the search ended after 10 min" in note for note in found.notes)
    assert asked < steps + 12  # each stage of the search asks once, and the residuals


@pytest.fixture(scope="module")
def traces(logs: dict[str, list[Path]]) -> dict[str, Trace]:
    return {name: traced(paths) for name, paths in logs.items()}


def test_plant_as_declared_has_no_effect(traces: dict[str, Trace]) -> None:
    found = traces["none"]
    assert found.found.point.placed == ()
    assert pooled(found.after) == pooled(found.before)


@pytest.mark.parametrize("name", ["none", "cubic"])
def test_remaining_error_of_held_out_records_is_noise(traces: dict[str, Trace], name: str) -> None:
    error, floor = pooled(traces[name].after)
    # 11 s of a motion that decays within 0.3 s determine the rms of the noise to 10 %; three times
    # that.
    assert error == pytest.approx(floor, rel=0.3)


@pytest.mark.parametrize(("name", "numbers"), [("cubic", (1e6,)), ("coulomb", (3e-3, 0.1))])
def test_free_run_errs_no_more_than_with_the_numbers_of_the_plant(
    traces: dict[str, Trace], name: str, numbers: tuple[float, ...]
) -> None:
    """A friction turns within a row, so that its free run errs by more than the noise even then."""
    found = traces[name].found.point
    (law,) = found.placed
    own = law.with_values(numbers[: len(law.shape)], numbers[len(law.shape) :])
    model = found.model.with_values({"m": MASS, "d": DAMPER, "k": SPRING})
    plant = replace(found, model=model, placed=(own,))
    error, least = (
        pooled(Alone(CONFIG).map(partial(record_error, point), traces[name].records))[0]
        for point in (found, plant)
    )
    # The same: all records determine the rms to 5 %; three times that.
    assert error < 1.15 * least


@pytest.mark.parametrize(
    ("name", "key", "amplitude"),
    [("cubic", "stiffness.cubic", 1e6), ("coulomb", "friction.coulomb", 0.1)],
)
def test_undeclared_effect_is_found_with_its_amplitude(
    traces: dict[str, Trace], name: str, key: str, amplitude: float
) -> None:
    found = traces[name]
    assert [p.effect.key for p in found.found.point.placed] == [key]
    placed = found.found.point.placed[0]
    se = placed.standard_errors[placed.effect.amplitudes[0].name]
    # Four standard errors, and 1 % for numerical derivatives of the readings.
    assert abs(placed.amplitudes[0] - amplitude) < 4 * se + 0.01 * amplitude
    assert se < 0.05 * amplitude
    assert pooled(found.before)[0] > 3 * pooled(found.after)[0]


def test_saturation_far_below_the_largest_command_is_found(tmp_path: Path) -> None:
    # The limit is 0.27 of the largest command. A squared characteristic that flattens explains 0.97
    # of what this saturation explains at its start values.
    logs = [
        imported(tmp_path, f"clipped-{i}", flown(i, rms_n, clip_n=4.0))
        for i, rms_n in enumerate(RMS_N)
    ]
    found = traced(logs)
    (placed,) = found.found.point.placed
    assert placed.effect.key == "saturation"
    assert placed.shape[0] == pytest.approx(4.0, rel=0.02)
    # An amplitude of one is the maximum.
    assert placed.amplitudes[0] == pytest.approx(1.0, abs=0.02)
    assert placed.amplitudes[0] <= 1.0
    error, floor = pooled(found.after)
    assert error == pytest.approx(floor, rel=0.3)


def test_unstable_plant_is_rejected_in_open_loop(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    pushed = rng.standard_normal(ROWS)
    # The declared plant is unstable from any initial state; the readings stay near zero.
    held = np.stack([pushed, 1e-4 * rng.standard_normal(ROWS)], axis=1)
    config = parse_text(
        MODEL.replace("{value: 700.0, unit: N/m, min: 1, max: 10000}",
                      "{value: -2000.0, unit: N/m, fixed: true}"),
        ModelConfig, "mass",
    )  # fmt: skip
    logs = [imported(tmp_path, f"held-{i}", np.roll(held, 7 * i, axis=0)) for i in range(3)]
    with pytest.raises(IdentificationError, match="trace an unstable plant in closed loop"):
        traced(logs, config)


def test_parameters_of_the_model_are_not_biased_by_the_effect(
    traces: dict[str, Trace],
) -> None:
    point = traces["cubic"].found.point
    for name, value in {"m": MASS, "d": DAMPER, "k": SPRING}.items():
        # A model refitted without the cubic spring is a few percent stiffer; with it the error is
        # that of the noise, about 1e-3.
        assert point.model.values[name] == pytest.approx(value, rel=0.01)


def test_held_out_records_are_not_fitted(traces: dict[str, Trace]) -> None:
    for name, found in traces.items():
        assert found.held == (f"{name}-1",)
        assert found.fitted == tuple(f"{name}-{i}" for i in (0, 2, 3))
        assert [e.name for e in found.before] == list(found.held)


def sources(paths: list[Path]) -> list[RecordSource]:
    span = (0.0, (ROWS - 1) * TS)
    whole = [RecordSource.of(path, 0, ROWS, span) for path in paths]
    return [*whole, *(RecordSource.of(path, 700, 2950, span) for path in paths)]


def assert_same_results(found: Trace, logs: list[Path], others: Workers) -> None:
    """Compare the results of workers with those of this process, to the last digit."""
    alone, point, parts = Alone(CONFIG), found.found.point, sources(logs)
    assert point.placed  # otherwise the comparison would be trivial
    some = [(e, e.grid[0]) for e in all_effects(found.places)[:6]]
    here, there = (
        w.map(partial(linearise, point, candidates=some), parts) for w in (alone, others)
    )
    for one, other in zip(here, there, strict=True):
        np.testing.assert_array_equal(one.gram, other.gram)
        np.testing.assert_array_equal(one.size, other.size)
    assert [one.name for one in here] == [path.stem for path in logs] * 2
    here, there = (w.map(partial(record_error, point), parts) for w in (alone, others))
    for one, other in zip(here, there, strict=True):
        assert (one.name, one.rows, one.squares, one.floor, one.settled) == (
            other.name, other.rows, other.squares, other.floor, other.settled,
        )  # fmt: skip
        np.testing.assert_array_equal(one.psd, other.psd)


@pytest.fixture(scope="module")
def processes() -> Iterator[Workers]:
    with local_workers(CONFIG, 2) as workers:
        yield workers


def test_worker_processes_give_the_same_results_to_the_last_digit(
    traces: dict[str, Trace], logs: dict[str, list[Path]], processes: Workers
) -> None:
    assert_same_results(traces["cubic"], logs["cubic"], processes)


def test_results_have_the_order_of_the_tasks(
    logs: dict[str, list[Path]], processes: Workers
) -> None:
    paths = logs["none"]
    tasks = [
        RecordSource.of(paths[i % 4], 0, 100 + 300 * (i * 5 % 7), (0.0, 1.0)) for i in range(12)
    ]
    answers = processes.map(attrgetter("name", "rows"), tasks)
    assert answers == [(s.path.stem, s.stop) for s in tasks]


def test_records_of_equal_names_are_distinguished_by_their_folder(tmp_path: Path) -> None:
    paths = []
    for seed, day in enumerate(("monday", "tuesday")):
        (tmp_path / day).mkdir()
        paths.append(imported(tmp_path / day, "still", flown(seed, 1.0)))
    records, _ = read_records(paths, CONFIG)
    names = [r.name for r in records.values()]
    assert names == ["still (monday/still.mcap)", "still (tuesday/still.mcap)"]
    # Workers read them again and use the same names.
    tasks = [
        RecordSource.of(p, 0, ROWS, (0.0, 1.0), name=n) for p, n in zip(paths, names, strict=True)
    ]
    assert Alone(CONFIG).map(attrgetter("name"), tasks) == names


def test_all_records_of_sessions_with_equal_names_are_used(
    tmp_path: Path, logs: dict[str, list[Path]]
) -> None:
    (tmp_path / "again").mkdir()
    again = [
        imported(tmp_path / "again", path.stem, flown(10 + i, RMS_N[i]))
        for i, path in enumerate(logs["none"][:2])
    ]
    found = traced([*logs["none"][:2], *again])
    assert len({*found.fitted, *found.held}) == 4
    seen = views(found, Alone(CONFIG))
    assert {record.name for record in seen.records} == {*found.fitted, *found.held}
    assert {record.name for record in seen.records if record.held} == set(found.held)


def test_changed_log_is_read_again(tmp_path: Path, logs: dict[str, list[Path]]) -> None:
    path, workers = tmp_path / "again.mcap", Alone(CONFIG)
    answers = []
    for log in (logs["none"][0], logs["cubic"][0]):
        path.write_bytes(log.read_bytes())
        tasks = [RecordSource.of(path, 0, ROWS, (0.0, 1.0))]
        answers += workers.map(attrgetter("gap"), tasks)
    assert np.any(answers[0] != answers[1])


def test_record_too_short_to_hold_data_out_is_rejected(tmp_path: Path) -> None:
    log = imported(tmp_path, "short", flown(0, 3.0)[:500])
    with pytest.raises(IdentificationError):
        traced([log])


def test_no_records_are_rejected() -> None:
    with pytest.raises(IdentificationError, match="expected records among the 0 logs, found none"):
        traced([])
