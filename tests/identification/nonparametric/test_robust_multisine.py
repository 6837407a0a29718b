"""Test the robust multisine method: exactness without noise, coverage, detection of distortion."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from levid.config.base import load_yaml, parse_text
from levid.config.rig import load_rig
from levid.config.session import Excitation, Orthogonal, SessionConfig
from levid.config.shipped import shipped
from levid.config.sim import SimConfig
from levid.daemon.loop.virtual_session import fly_virtually
from levid.daemon.planning.orthogonal_multisine import orthogonal_multisines
from levid.identification import run_identification as studies
from levid.identification.nonparametric.nonlinear_distortion import excess
from levid.identification.nonparametric.robust_multisine import (
    BestLinearApproximation,
    at_every_position,
    best_linear_approximation,
    response_estimate,
)
from levid.identification.options import Options
from levid.identification.records.periodic_records import (
    IncompleteError,
    NotPeriodicError,
    PeriodicRecord,
    _complete,
    periodic_record,
    periodic_records,
)
from levid.identification.records.record import IdentificationError
from levid.identification.records.signal_names import SignalNames
from levid.log.reader import Log, read_log
from levid.sim.true_response import frequency_response

RATE_HZ, PERIOD_S, P = 100.0, 4.0, 4
N = round(RATE_HZ * PERIOD_S)


def excitations(p: int, **more: object) -> list[Excitation]:
    text = {"signal": "multisine", "period_s": PERIOD_S, "band_hz": [1, 40]}
    return [
        Excitation.model_validate(
            {"input": f"coil:{j}", "rms_n": 1.0, "lines": "odd_random_grid", **text, **more}
        )
        for j in range(p)
    ]


def multisines(p: int, realisations: int, seed: int) -> np.ndarray:
    """Return orthogonal multisines; `seed` sets the phases, the lines are always the same."""
    plan = Orthogonal(realisations=realisations, periods=P)
    return played(
        orthogonal_multisines(excitations(p), plan, RATE_HZ, 1, seed), p * realisations * P
    )


def played(periods: Iterator[np.ndarray], n: int) -> np.ndarray:
    """Return the first n periods, without the end that fades out."""
    return np.concatenate(list(islice(periods, n)))


def periodic(v: np.ndarray, y: np.ndarray, p: int, drop: int = 1) -> PeriodicRecord:
    """Cut open-loop input and output into experiments of P periods, without the first `drop`."""

    def cut(x: np.ndarray) -> np.ndarray:
        return x.reshape(-1, P, N, x.shape[1])[:, drop:]

    names = tuple(f"{j}" for j in range(p))
    outputs = tuple(f"{i}" for i in range(y.shape[1]))
    return PeriodicRecord("test", 1 / RATE_HZ, cut(v), cut(y), None, len(v) // (p * P * N),
                          names, names, outputs, outputs)  # fmt: skip


def impulse_response(m: int, p: int) -> np.ndarray:
    """Return taps shorter than a second, so that one dropped period removes the transient."""
    g = np.random.default_rng(7).normal(size=(60, m, p))
    return g * 0.9 ** np.arange(60)[:, None, None]


def filtered(v: np.ndarray, g: np.ndarray) -> np.ndarray:
    y = np.zeros((len(v), g.shape[1]))
    for i in range(g.shape[1]):
        for j in range(g.shape[2]):
            y[:, i] += np.convolve(v[:, j], g[:, i, j])[: len(v)]
    return y


def response(g: np.ndarray, freq_hz: np.ndarray) -> np.ndarray:
    z = np.exp(-2j * np.pi * freq_hz[:, None] / RATE_HZ * np.arange(len(g)))
    return np.einsum("fl,lij->fij", z, g)


@pytest.mark.parametrize(("m", "p"), [(1, 1), (2, 2), (3, 3), (3, 2), (2, 4)])
def test_without_noise_the_response_is_exact(m: int, p: int) -> None:
    g = impulse_response(m, p)
    v = multisines(p, 1, seed=1)
    found = best_linear_approximation([periodic(v, filtered(v, g), p)])
    # Steady state of a finite response over whole periods: only rounding is left.
    np.testing.assert_allclose(found.H, response(g, found.freq_hz), atol=1e-11)
    assert np.all(found.odd.level < 1e-12)
    assert np.all(found.even.level < 1e-12)


@pytest.mark.parametrize("stalls", [[(700, 8)], [(k, 2) for k in range(30, 9000, 90)]])
def test_commands_held_over_skipped_cycles_add_no_excited_lines(
    stalls: list[tuple[int, int]],
) -> None:
    g = impulse_response(2, 3)
    v = multisines(3, 2, seed=1)
    smooth = best_linear_approximation([periodic(v, filtered(v, g), 3)])
    for row, length in stalls:
        v[row : row + length] = v[row]
    # A skip acts like noise; no other noise is added here.
    found = best_linear_approximation([periodic(v, filtered(v, g), 3)])
    np.testing.assert_array_equal(found.freq_hz, smooth.freq_hz)
    assert len(found.odd.freq_hz) == len(smooth.odd.freq_hz)
    error = np.abs(found.H - response(g, found.freq_hz)) / np.abs(found.H).max()
    assert np.median(error) < 0.05  # the transient of a stall continues into the next period


def test_inputs_with_different_lines_are_rejected() -> None:
    v = multisines(2, 2, seed=1)
    spectrum = np.fft.rfft(v[:, 1].reshape(-1, N), axis=1)
    spectrum[:, np.flatnonzero(np.abs(spectrum[0]) > 1e-6)[10]] = 0.0
    v[:, 1] = np.fft.irfft(spectrum, N, axis=1).ravel()
    with pytest.raises(IdentificationError, match="excited at the same lines"):
        best_linear_approximation([periodic(v, v, 2)])


@pytest.mark.parametrize(("p", "realisations"), [(2, 1), (2, 2), (3, 2), (1, 4)])
def test_confidence_intervals_have_95_percent_coverage(p: int, realisations: int) -> None:
    g = impulse_response(2, p)
    colour = np.array([[1.0, 0.4], [0.0, 0.8]])
    inside, shared, noise_only = [], [], []
    for seed in range(20):
        v = multisines(p, realisations, seed)
        noise = 0.3 * np.random.default_rng(seed).normal(size=(len(v), 2)) @ colour
        found = best_linear_approximation([periodic(v, filtered(v, g) + noise, p)])
        error = np.abs(found.H - response(g, found.freq_hz))
        inside.append(error < found.radius())
        shared.append(error < 1.73 * response_estimate(found).standard_deviation)
        noise_only.append(error < 1.73 * found.noise_deviation)
    # 20 x 59 lines x 2 p entries; the p columns of a line share their variance estimate. Two
    # standard errors of the coverage are 0.5 %.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.01)
    assert np.mean(shared) == pytest.approx(0.95, abs=0.01)
    # Gaussian intervals with 4 degrees of freedom have less coverage: (1 + 3 / 4)^-4 are outside.
    assert 0.89 < np.mean(noise_only) < 0.96


def test_one_realisation_leaves_distortion_unknown() -> None:
    v = multisines(2, 1, 1)
    y = filtered(v, impulse_response(2, 2)) + np.random.default_rng(1).normal(size=v.shape)
    found = best_linear_approximation([periodic(v, y, 2)])
    assert found.freedom == found.noise_freedom == 2 * 2
    assert np.all(np.isnan(found.distortion_variance))
    assert np.all(np.isnan(found.test().p_value))
    assert np.all(np.isfinite(found.radius()))


def distorted(seed: int, power: int, *, noise: float = 0.02, size: float = 0.05):
    """Identify a plant whose two inputs are mixed before a static nonlinearity."""
    v = multisines(2, 3, seed)
    mixed = v @ np.array([[1.0, 0.3], [-0.4, 0.8]])
    y = filtered(mixed + size * mixed**power, impulse_response(2, 2))
    y += noise * np.random.default_rng(seed).normal(size=y.shape)
    return best_linear_approximation([periodic(v, y, 2)])


def test_intervals_cover_the_best_linear_approximation_of_a_nonlinear_plant() -> None:
    truth = np.mean([distorted(seed, 3).H for seed in range(1000, 1200)], axis=0)
    inside, noise_only = [], []
    for seed in range(40):
        found = distorted(seed, 3)
        error = np.abs(found.H - truth)
        inside.append(error < found.radius())
        noise_only.append(error < 1.73 * found.noise_deviation)
    # Distortion with 4 degrees of freedom, not exactly Gaussian and correlated between
    # neighbouring lines: 92 to 98 % are required.
    assert 0.92 < np.mean(inside) < 0.98
    assert np.mean(noise_only) < 0.5  # intervals from the noise alone are far too narrow


def cubic(seed: int, realisations: int, *, flights: int = 2) -> list[PeriodicRecord]:
    """Return several flights of the same excitation on a cubic plant, each with its own noise."""
    v = multisines(1, realisations, seed)
    y = filtered(v + 0.05 * v**3, impulse_response(1, 1))
    rng = np.random.default_rng(seed)
    return [periodic(v, y + 0.02 * rng.normal(size=y.shape), 1) for _ in range(flights)]


def test_repeated_session_does_not_count_as_further_realisations() -> None:
    truth = np.mean(
        [best_linear_approximation(cubic(seed, 3, flights=1)).H for seed in range(1000, 1300)],
        axis=0,
    )
    inside, squares, stated = [], [], []
    for seed in range(100):
        found = best_linear_approximation(cubic(seed, 3))
        assert (found.freedom, found.noise_freedom) == (3 - 1, 2 * 3 * 3 - 3)
        error = np.abs(found.H - truth)
        inside.append(error < found.radius())
        squares.append(error**2)
        stated.append(found.standard_deviation**2)
    # Distortion is correlated between neighbouring lines: 100 seeds give about 1000 independent
    # errors and a coverage known to 0.7 %; three of that, and 1 % for non-Gaussian distortion.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.03)
    # 1000 variances with 2 degrees of freedom: their mean scatters by 1 / sqrt(1000).
    assert np.mean(squares) / np.mean(stated) == pytest.approx(1.0, abs=0.2)
    assert "3 of 6 experiments repeat the excitation of others" in found.remarks[0]


def test_one_realisation_flown_twice_leaves_distortion_unknown() -> None:
    found = best_linear_approximation(cubic(1, 1))
    assert found.freedom == found.noise_freedom == 2 * 3 - 1
    assert np.all(np.isnan(found.distortion_variance))
    assert np.all(np.isnan(found.test().p_value))


def test_repeated_flights_add_degrees_of_freedom_to_the_noise_estimate() -> None:
    v = multisines(2, 2, 1)
    y = filtered(v, impulse_response(2, 2))
    inside = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        # The first realisation is flown three times, the second one once.
        parts = [(v, y), (v[: len(v) // 2], y[: len(v) // 2]), (v[: len(v) // 2], y[: len(v) // 2])]
        records = [periodic(a, b + 0.3 * rng.normal(size=b.shape), 2) for a, b in parts]
        found = best_linear_approximation(records)
        assert (found.freedom, found.noise_freedom) == (4 - 2, 8 * 3 - 4)
        assert found.odd.experiments == found.even.experiments == 4
        assert found.odd.noise_freedom == 8 * 3 - 4
        assert np.all(found.odd.test().p_value > 1e-4)
        error = np.abs(found.H - response(impulse_response(2, 2), found.freq_hz))
        inside.append(error < np.sqrt(-np.log(0.05)) * found.noise_deviation)
    # One standard error is 0.5 % as above; with 20 degrees of freedom the coverage is
    # 1 - (1 + 3 / 20)^-20 = 0.94.
    assert np.mean(inside) == pytest.approx(0.94, abs=0.015)


def test_records_of_different_levels_are_not_combined() -> None:
    def at(scale: float, seed: int) -> PeriodicRecord:
        v = scale * multisines(1, 3, seed)
        y = filtered(v + 0.05 * v**3, impulse_response(1, 1))
        return replace(periodic(v, y, 1), name=f"{scale:g}", beam_m=0.0)

    records = [at(1.0, 1), at(0.5, 2), at(1.01, 3)]
    with pytest.raises(IdentificationError, match=r"one level of every input, found rms 1 in '1'"):
        best_linear_approximation(records)
    found = at_every_position(records)
    assert [f.records for f in found] == [("1", "1.01"), ("0.5",)]
    assert [f.freedom for f in found] == [6 - 1, 3 - 1]


def test_odd_and_even_distortion_are_detected_at_their_lines() -> None:
    nothing, cubic, square = (distorted(3, power, size=s) for power, s in
                              ((3, 0.0), (3, 0.05), (2, 0.05)))  # fmt: skip
    for found, odd, even in ((nothing, False, False), (cubic, True, False), (square, False, True)):
        # A false alarm has a probability of 0.001 in each of 12 tests.
        assert np.all((found.odd.test().p_value < 1e-3) == odd)
        assert np.all((found.even.test().p_value < 1e-3) == even)
    # Even distortion of odd lines appears at even lines only and does not affect the response.
    assert np.all(nothing.test().p_value > 1e-3)
    assert np.all(square.test().p_value > 1e-3)
    assert np.all(cubic.test().p_value < 1e-12)
    # The power of odd distortion is equal at excited lines and at detection lines, because its
    # spectrum is smooth. 59 lines with 4 and 19 lines with 6 degrees of freedom determine it to
    # 10 %; excited lines lack a few percent that are in phase with the excitation.
    by_scatter = np.mean(cubic.total_level**2 - cubic.noise_level**2, axis=0)
    by_detection = np.mean(cubic.odd.level**2 - cubic.odd.noise**2, axis=0)
    np.testing.assert_allclose(by_scatter, by_detection, rtol=0.4)


@pytest.mark.parametrize(("freedom", "noise_freedom"), [(3, 3), (6, 18)])
def test_p_values_are_uniform_without_distortion(freedom: int, noise_freedom: int) -> None:
    # 3 and 3: one realisation of three inputs, two periods in steady state. The ratios then have
    # no third moment; an earlier version had 120 of 30 000 values below 1e-4 and 50 below 1e-6.
    rng = np.random.default_rng(4)
    values, lines = 30_000, 100
    power = rng.gamma(freedom, 1 / freedom, (lines, values))
    noise = rng.gamma(noise_freedom, 1 / noise_freedom, (lines, values))
    p_values = excess(power, noise, freedom, noise_freedom).p_value
    # The share below p scatters by sqrt(p (1 - p) / values); four of that.
    for p in (1e-3, 0.05, 0.5, 0.95):
        four = 4 * np.sqrt(p * (1 - p) / values)
        assert np.mean(p_values < p) == pytest.approx(p, abs=four)
    # 3 are expected; more than 9 have a probability of 0.001 (Poisson).
    assert np.count_nonzero(p_values < 1e-4) <= 9


def test_p_values_detect_few_strong_lines_and_many_weak_lines() -> None:
    rng = np.random.default_rng(5)
    lines, values = 100, 300
    few, many = np.ones((lines, 1)), np.full((lines, 1), 1.6)
    few[:3] = 21.0
    power, noise = (rng.gamma(n, 1 / n, (lines, values)) for n in (6, 18))
    for amplified in (few, many):
        # Of 3000 simulations all but 5 had p < 1e-3; the mean normal score detects `few` in 16 %.
        assert np.mean(excess(amplified * power, noise, 6, 18).p_value < 1e-3) > 0.97


def test_p_values_are_finite_for_extremely_strong_lines() -> None:
    power, noise = np.ones((20, 2)), np.ones((20, 2))
    power[3] = 0.0, 1e300
    assert excess(power, noise, 6, 18).p_value[1] < 1e-200
    assert excess(power, noise, 6, 18).p_value[0] > 0.01


def test_transient_in_the_periods_gives_a_remark() -> None:
    g = 0.995 ** np.arange(2000)[:, None, None]  # decays by 1 / e in 2 s, half a period
    v = multisines(1, 3, 2)
    y = filtered(v, g) + 0.01 * np.random.default_rng(2).normal(size=v.shape)
    assert "transient" in best_linear_approximation([periodic(v, y, 1)]).remarks[0]
    fast = filtered(v, g[:50]) + 0.01 * np.random.default_rng(2).normal(size=v.shape)
    assert best_linear_approximation([periodic(v, fast, 1)]).remarks == ()


def test_names_and_units_of_the_records_are_kept() -> None:
    v = multisines(2, 1, 1)
    record = replace(
        periodic(v, filtered(v, impulse_response(1, 2)), 2),
        input_names=("left", "right"),
        input_units=("V", "A"),
        output_names=("tip",),
        output_units=("m",),
    )
    signals = best_linear_approximation([record]).signals
    assert signals == SignalNames(("left", "right"), ("V", "A"), ("tip",), ("m",), 1 / RATE_HZ)
    other = replace(record, input_units=("V", "V"))
    with pytest.raises(IdentificationError, match=r"one inputs, found left \[V\], right \[A\] in"):
        best_linear_approximation([record, other])


def test_incompatible_or_insufficient_records_are_rejected() -> None:
    v = multisines(2, 1, 1)
    good = periodic(v, v, 2)
    with pytest.raises(IdentificationError, match="at least one record"):
        best_linear_approximation([])
    with pytest.raises(IdentificationError, match=r"sampling time, found 0\.01 in 'test'"):
        best_linear_approximation([good, replace(good, Ts_s=0.02)])
    with pytest.raises(IdentificationError, match=r"of one position, found .*0.0 mm .*50.0 mm"):
        best_linear_approximation([replace(good, beam_m=0.0), replace(good, beam_m=0.05)])
    with pytest.raises(IdentificationError, match="at least two periods in steady state, found 1"):
        best_linear_approximation([periodic(v, v, 2, drop=3)])
    alike = replace(good, v=good.v[..., [0, 0]])
    with pytest.raises(IdentificationError, match="proportional in all 2"):
        best_linear_approximation([alike])
    silent = replace(good, v=good.v * [1.0, 0.0])
    with pytest.raises(IdentificationError, match="every input to be excited"):
        best_linear_approximation([silent])
    turned = good.v.copy()
    turned[..., 1] *= np.cos(2 * np.pi * np.arange(N) / N)  # moves its lines by one
    with pytest.raises(IdentificationError, match="same lines"):
        best_linear_approximation([replace(good, v=turned)])
    with pytest.raises(
        IdentificationError, match=r"beam at \+0\.0 mm: expected independent inputs"
    ):
        at_every_position([replace(alike, beam_m=0.0)])


# --- in the rig's loop ---------------------------------------------------------------------------


@pytest.mark.parametrize("x_b_m", [-0.1, 0.0, 0.1])
def test_plant_identified_in_the_loop_agrees_with_the_truth(rig, x_b_m: float) -> None:
    """Two realisations with periods of 8 s, of which two count: 144 s in all."""
    R, periods, rate_hz = 2, 3, 1000.0
    shipped_ones = parse_text(
        shipped("sessions/multisine-1khz.yaml").read_bytes(), SessionConfig, "session"
    ).excitations
    multisines = orthogonal_multisines(
        [shipped_ones[name] for name in ("psi", "theta", "z")],
        Orthogonal(realisations=R, periods=periods),
        rate_hz,
        1,
        0,
    )
    v = played(multisines, 3 * R * periods)
    y, u = rig.simulate(rig.sampled_plant(x_b_m, 1 / rate_hz), v, seed=3)

    def cut(x: np.ndarray) -> np.ndarray:
        return x.reshape(3 * R, periods, 8000, 3)[:, 1:]

    names = ("psi", "theta", "z")
    record = PeriodicRecord(
        "rig", 1 / rate_hz, cut(v), cut(y), cut(u), R, names, names, names, names
    )
    found = best_linear_approximation([record])
    true = rig.sampled_plant(x_b_m, 1 / rate_hz).frequency_response(found.freq_hz)
    band = (found.freq_hz >= 1) & (found.freq_hz <= 64)
    ratio = (found.H / true)[band]
    decibel, degree = np.abs(20 * np.log10(np.abs(ratio))), np.abs(np.angle(ratio, deg=True))
    # 0.5 dB and 3 degrees are required; the limits are three times the largest error over seeds.
    assert np.einsum("fii->fi", decibel).max() < 0.06
    assert np.einsum("fii->fi", degree).max() < 0.3
    # Off-diagonal entries 20 dB above their noise: 1 dB is one standard deviation.
    stands = np.abs(found.H[band]) > 10 * found.radius()[band]
    assert decibel[stands].max() < 2.0
    inside = (np.abs(found.H - true) < found.radius())[band]
    # 189 lines x 3 independent rows: the standard error is 0.9 %.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.03)
    assert np.all(found.test().p_value > 1e-4)
    assert np.all(found.odd.test().p_value > 1e-4)
    assert np.all(found.even.test().p_value > 1e-4)
    assert found.remarks == ()


# --- flown ---------------------------------------------------------------------------------------

SESSION = """
levid: session
name: multisine-short
rate_hz: RATE
excitations:
  psi: {input: psi, rms_n_m: 0.32, signal: multisine, period_s: 8, band_hz: [0.5, 100], lines: odd_random_grid, rise_hz: 10}
  theta: {input: theta, rms_n_m: 0.32, signal: multisine, period_s: 8, band_hz: [0.5, 100], lines: odd_random_grid, rise_hz: 10}
  z: {input: z, rms_n: 4, signal: multisine, period_s: 8, band_hz: [0.5, 100], lines: odd_random_grid, rise_hz: 10}
  half-psi: {input: psi, rms_n_m: 0.16, signal: multisine, period_s: 8, band_hz: [0.5, 100], lines: odd_random_grid, rise_hz: 10}
  half-theta: {input: theta, rms_n_m: 0.16, signal: multisine, period_s: 8, band_hz: [0.5, 100], lines: odd_random_grid, rise_hz: 10}
  half-z: {input: z, rms_n: 2, signal: multisine, period_s: 8, band_hz: [0.5, 100], lines: odd_random_grid, rise_hz: 10}
  noise: {input: psi, rms_n_m: 0.05}
steps:
  - levitate: {}
  - move: {beam_m: 0.1}
  - record: {name: whole, excite: [psi, theta, z], orthogonal: {realisations: 2, periods: 3}}
  - record: {name: half, excite: [half-psi, half-theta, half-z], orthogonal: {realisations: 2, periods: 3}}
  - record: {name: white, duration_s: 2, excite: [noise]}
  - land: {}
"""  # noqa: E501


def fly(out: Path, sim: str, rate_hz: int) -> list[Log]:
    rig_file = shipped("rigs/loopback.yaml")
    rig = load_rig(rig_file).model_copy(update={"sim": str(shipped(f"sims/{sim}.yaml"))})
    text = SESSION.replace("RATE", str(rate_hz))
    session = parse_text(text, SessionConfig, "session")
    flown = fly_virtually(rig, rig_file, session, text.encode(), out)
    return [read_log(path) for path in flown.logs]


@pytest.fixture(scope="module")
def nominal(tmp_path_factory: pytest.TempPathFactory) -> list[Log]:
    return fly(tmp_path_factory.mktemp("nominal") / "logs", "nominal", 500)


@pytest.fixture(scope="module")
def whole_record(nominal: list[Log]) -> PeriodicRecord:
    return periodic_record(nominal[2])


@pytest.fixture(scope="module")
def nonlinear(tmp_path_factory: pytest.TempPathFactory) -> list[Log]:
    return fly(tmp_path_factory.mktemp("rig") / "logs", "rig", 1000)


def both(logs: list[Log]) -> list[BestLinearApproximation]:
    records, _ = periodic_records(logs)
    return [best_linear_approximation([record]) for record in records]


def test_logs_without_orthogonal_multisines_are_skipped_by_name(nominal: list[Log]) -> None:
    records, skipped = periodic_records(nominal)
    assert [r.name for r in records] == ["whole", "half"]
    assert records[0].v.shape == (6, 2, 4000, 3)
    assert records[0].beam_m == pytest.approx(0.1, abs=1e-6)
    assert any("04-white.mcap: record 'white' has no orthogonal multisines" in s for s in skipped)
    with pytest.raises(NotPeriodicError, match="'white' has no orthogonal multisines"):
        periodic_record(nominal[4])


def test_flown_linear_plant_agrees_with_the_truth_without_distortion(nominal: list[Log]) -> None:
    config = load_yaml(shipped("sims/nominal.yaml"), SimConfig)
    for found in both(nominal):
        true = frequency_response(config, 0.1, found.freq_hz, 500.0)
        inside = np.abs(found.H - true) < found.radius()
        # 299 lines x 3 rows: the standard error is 0.7 %.
        assert np.mean(inside) == pytest.approx(0.95, abs=0.03)
        for test in (found.test(), found.odd.test(), found.even.test()):
            assert np.all(test.p_value > 1e-4)
    apart = at_every_position(periodic_records(nominal)[0])
    assert [found.records for found in apart] == [("whole",), ("half",)]
    assert [found.freedom for found in apart] == [6 - 3, 6 - 3]


def test_hardening_spring_gives_odd_distortion_that_grows_with_amplitude(
    nonlinear: list[Log],
) -> None:
    whole, half = both(nonlinear)
    # The rods' cubic stiffness is largest in z, relative to the noise.
    assert whole.test().p_value[2] < 1e-12
    # 99 odd lines with 6 degrees of freedom are less powerful than 299 excited lines: p = 2e-9.
    assert whole.odd.test().p_value[2] < 1e-6
    assert whole.even.test().p_value[2] > 1e-6
    near = whole.freq_hz < 12.0
    level = [np.sqrt(np.mean(b.distortion_variance[near, 2, 2])) for b in (whole, half)]
    # At half the amplitude a cubic force is 1/8, relative to the response 1/4: it falls from four
    # times the noise to the noise level, where it is no longer significant.
    assert level[0] > 2.0 * level[1]
    assert half.test().p_value[2] > 1e-6


def test_truncated_log_gives_its_complete_realisations(
    nominal: list[Log], whole_record: PeriodicRecord
) -> None:
    log = nominal[2]
    begin, realisation = 1500, 3 * 3 * 4000
    cut = replace(log, rows=log.rows[: begin + realisation + 2500])
    record = periodic_record(cut)
    assert record.realisations == 1
    assert "1 of 2 realisations are complete" in record.remarks
    np.testing.assert_array_equal(record.y, whole_record.y[:3])
    with pytest.raises(IncompleteError, match="one complete realisation of 72 s, found 71 s"):
        periodic_record(replace(log, rows=log.rows[: begin + realisation - 500]))


def test_unusable_record_or_method_does_not_end_a_study(
    nominal: list[Log], monkeypatch: pytest.MonkeyPatch
) -> None:
    half = nominal[3]
    rows = {half.path: half.rows[:25_000]}  # 50 s of 72 s; record 'white' excites psi alone for 2 s
    logs = {log.path: replace(log, rows=rows.get(log.path, log.rows)) for log in nominal}
    monkeypatch.setattr(studies, "read_log", logs.__getitem__)
    found = studies.study(list(logs), lambda _log: None, Options())
    assert [bla.records for bla in found.multisine] == [("whole",)]
    assert found.points is None
    notes = "; ".join(found.notes)
    assert "03-half.mcap: expected at least one complete realisation" in notes
    assert "no Markov parameters: beam at +100.0 mm: expected records that excite psi" in notes


def test_position_without_an_approximation_does_not_end_a_study() -> None:
    v = multisines(2, 2, 1)
    good = replace(periodic(v, v, 2), beam_m=0.0)
    silent = replace(good, v=good.v * [1.0, 0.0], beam_m=0.1)
    found, refused = studies._multisine([silent, good])
    assert [bla.beam_m for bla in found] == [0.0]
    (error,) = refused
    assert str(error).startswith("beam at +100.0 mm: expected every input to be excited")


@pytest.mark.parametrize("skipped", [1, 40])
def test_skipped_cycles_discard_only_their_realisation(
    nominal: list[Log], whole_record: PeriodicRecord, skipped: int
) -> None:
    log, complete = nominal[2], whole_record
    rows = log.rows.copy()
    # The plan waits during skipped cycles: the row after them is the next one of the plan.
    rows["cycle"][10_000:] += skipped
    record = periodic_record(replace(log, rows=rows))
    assert (record.realisations, complete.realisations) == (1, 2)
    assert "1 of 2 realisations are complete, none of its periods skipped" in record.remarks
    np.testing.assert_array_equal(record.v, complete.v[-len(record.v) :])
    np.testing.assert_array_equal(record.y, complete.y[-len(record.y) :])


def test_skipped_cycles_in_dropped_periods_discard_nothing() -> None:
    N, rows = 100, 1000
    at = np.arange(rows)
    at[350:] += 1  # within period 300 to 400, which is dropped
    begins = np.array([100, 200, 400])
    assert _complete(at, begins, N, rows + 1)
    assert not _complete(at, np.array([300]), N, rows + 1)
    assert not _complete(at, np.array([900]), N, rows - 5)  # truncated before its end


def test_later_parts_of_a_split_record_are_rejected(nominal: list[Log]) -> None:
    log = nominal[2]
    with pytest.raises(IncompleteError, match=r"part 2 of record .* is unknown"):
        periodic_record(replace(log, metadata={**log.metadata, "part": "2"}))


def test_period_other_than_the_sessions_is_rejected(nominal: list[Log]) -> None:
    log = nominal[2]
    text = log.attachments["session.yaml"].replace(b"period_s: 8", b"period_s: 7.9")
    wrong = replace(log, attachments={**log.attachments, "session.yaml": text})
    with pytest.raises(IdentificationError, match=r"repeat every 7.9 s, found periods that differ"):
        periodic_record(wrong)


def test_multisines_on_a_part_of_the_inputs_are_rejected(nominal: list[Log]) -> None:
    log = nominal[2]
    text = re.sub(rb"excite: \[[^]]*\]", b"excite: [z]", log.attachments["session.yaml"])
    alone = replace(log, attachments={**log.attachments, "session.yaml": text})
    with pytest.raises(NotPeriodicError, match=r"at all of psi, theta, z, found only z"):
        periodic_record(alone)
