"""Markov parameters by correlation: their error, and the gap of singular values that is left.

White noise is flown on the nominal rig, beam in the middle. The error of the correlation estimate
and the singular values of its Hankel matrix are compared with what the sample autocorrelation of
white noise predicts. Then one cause after the other is changed, and the records are made longer,
faster or simultaneous. docs/correlation.md explains the figures.

gap: s(9) / s(10). error ratio: s(10) over s(9) of the true Markov parameters. drawn: the true
Markov parameters plus random errors with the predicted covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy import fft, signal

from levid.benchmarks.harness.benchmark_runner import Figure, run
from levid.benchmarks.identification.correlation_gap_flight import ORDER, Array, Flight, fly
from levid.identification.nonparametric.markov_parameters import (
    convolve,
    correlation_standard_deviation,
    estimate_markov,
)
from levid.identification.subspace.ho_kalman import Scaling

TAPS_S = (0.2, 0.4, 0.8, 1.6, 3.2, 8.0)
SHORT_S, LONG_S = 0.4, 8.0
PLANT = 6
"""States of the plant."""
PERIOD_S = 20.0
"""Of the periodic excitation, longer than the response of the loop."""
SI = Scaling(np.ones(3), np.ones(3))


def measure(quick: bool) -> Iterator[Figure]:
    flights = [fly(seed) for seed in range(1, 3 if quick else 6)]
    draws = 3 if quick else 15
    for seconds in (SHORT_S, LONG_S) if quick else TAPS_S:
        yield from by_taps(flights, seconds, draws)
    yield from against_least_squares(flights)
    yield from causes(flights[0], quick, draws)
    yield from other_records(quick)
    yield from predicted(flights[0], quick, draws)


def by_taps(flights: Sequence[Flight], seconds: float, draws: int) -> Iterator[Figure]:
    """Yield errors and singular values for one number of taps, flown and predicted."""
    first, taps = flights[0], flights[0].taps(seconds)
    estimates = [flight.estimate(seconds) for flight in flights]
    pairs = list(zip(flights, estimates, strict=True))
    squares = np.mean([((g - f.g[:taps]) ** 2).mean(axis=0) for f, g in pairs], axis=0)
    variance = np.mean([(deviation(f)[:taps] ** 2).mean(axis=0) for f in flights], axis=0)
    sd, own = np.sqrt(squares / variance), np.eye(3, dtype=bool)
    errors = drawn_errors(first, taps, draws, first.excited[2])
    drawn = [first.g[:taps] + error for error in errors]
    by_flight = [f.singular_values(g) for f, g in pairs]
    by_draw = [first.singular_values(g) for g in drawn]
    least = [f.singular_values(f.estimate(seconds, "least_squares")) for f in flights]
    true = np.median([f.true_singular_values(taps) for f in flights], axis=0)
    gaps = [gap(s) for s in by_flight]
    for key, label, value in (
        ("sd_own", "sd over predicted, own axis", np.sqrt(np.mean(sd[own] ** 2))),
        ("sd_coupling", "sd over predicted, couplings", np.sqrt(np.mean(sd[~own] ** 2))),
        ("error_formula", "s(1) of the error, formula", resonance_error(first, taps)),
        (
            "error_drawn",
            "s(1) of the error, drawn",
            np.median([first.largest_of_error(g) for g in drawn]),
        ),
        ("error", "s(1) of the error, flown", np.median([f.largest_of_error(g) for f, g in pairs])),
        ("true_s1", "true s(1)", true[0]),
        ("true_s9", "true s(9)", true[-1]),
        ("s10_drawn", "s(10), drawn", np.median([s[ORDER] for s in by_draw])),
        ("s10", "s(10), flown", np.median([s[ORDER] for s in by_flight])),
        ("gap_drawn", "gap, drawn", np.median([gap(s) for s in by_draw])),
        ("gap", "gap, flown", np.median(gaps)),
        ("gap_least", "least gap of the flights", np.min(gaps)),
        ("gap_most", "largest gap of the flights", np.max(gaps)),
        ("least_squares_gap", "gap by least squares", np.median([gap(s) for s in least])),
        ("true_gap_of_6", "true s(6) / s(7)", true[PLANT - 1] / true[PLANT]),
        ("gap_of_6", "s(6) / s(7), flown", np.median([gap(s, PLANT) for s in by_flight])),
    ):
        yield Figure(f"taps_{seconds:g}s_{key}", float(value), "", f"taps {seconds:g} s: {label}")


def against_least_squares(flights: Sequence[Flight]) -> Iterator[Figure]:
    """Yield the standard deviations of the two estimators on the own axes, taps of 8 s."""
    sd, predicted, by_correlation, signal_to_noise = [], [], [], []
    for flight in flights:
        taps = flight.taps(LONG_S)
        found = estimate_markov(flight.records, taps, "least_squares")
        error = np.einsum("tii->ti", found.g - flight.g[:taps])
        sd.append(np.sqrt(np.mean(error**2, axis=0)))
        predicted.append(np.diagonal(found.standard_error))
        own = np.einsum("tii->ti", deviation(flight)[:taps])
        by_correlation.append(np.sqrt(np.mean(own**2, axis=0)))
        signal_to_noise.append(np.diagonal(flight.excited[0]) / found.residual_rms)
    ratio = np.sqrt(np.mean((np.array(sd) / np.array(predicted)) ** 2))
    yield Figure("least_squares_sd", float(ratio), "", "least squares: sd over predicted")
    over = np.median(np.array(by_correlation) / np.array(predicted), axis=0)
    for i, axis in enumerate(flights[0].records[0].output_names):
        label = f"{axis}: predicted sd of correlation over least squares"
        yield Figure(f"sd_over_least_squares_{axis}", float(over[i]), "", label)
        found_ratio = float(np.median(np.array(signal_to_noise)[:, i]))
        yield Figure(f"output_over_noise_{axis}", found_ratio, "", f"{axis}: rms output over noise")


def causes(flight: Flight, quick: bool, draws: int) -> Iterator[Figure]:
    """Yield the gap after one change each; the excitation is that of `flight`."""
    changed: dict[str, tuple[str, Callable[[], Flight]]] = {
        "half": ("half the excitation", partial(fly, 1, scale=0.5)),
        "quiet": (
            "no sensor and amplifier noise",
            partial(fly, 1, sim={"sensors": {"noise_m": 0.0}, "coils": {"noise_n": 0.0}}),
        ),
        "damped": ("air damping times 4", partial(fly, 1, sim={"air": {"d_n_s_m": 16.0}})),
        "integral": ("integral gains times 2", partial(fly, 1, integral=2.0)),
    }
    flown = {key: (label, make()) for key, (label, make) in changed.items() if not quick}
    linear = [replace(r, y=convolve(r.v, flight.g)) for r in flight.records]
    flown["linear"] = ("linear response to v, no noise", replace(flight, records=tuple(linear)))
    flown["none"] = ("nothing changed", flight)
    periodic = {"signal": "multisine", "period_s": PERIOD_S, "band_hz": [0.0, 500.0]}
    whole = whole_periods(fly(1, excitation=periodic))
    for seconds in (SHORT_S, LONG_S):
        taps = flight.taps(seconds)
        estimate = flight.estimate(seconds)
        gaps = {
            "delay": ("delay and lag not removed", gap(flight.with_delay(estimate))),
            "si": ("SI units, not scaled", gap(flight.singular_values(estimate, SI))),
            "periodic": (
                "periodic excitation, whole periods",
                gap(whole.singular_values(circular_correlation(whole)[:taps])),
            ),
        }
        for key, (label, other) in flown.items():
            for method in ("correlation", "least_squares"):
                values = other.singular_values(other.estimate(seconds, method))
                text = f"{label}, {method.replace('_', ' ')}"
                gaps[f"{key}_{method}"] = (text, gap(values))
        # The response to inputs that are older than the taps is removed from the output.
        cut = [replace(r, y=r.y - convolve(r.v, tail(flight.g, taps))) for r in flight.records]
        values = flight.singular_values(estimate_markov(cut, taps, "least_squares").g)
        gaps["cut_least_squares"] = ("response ends with the taps, least squares", gap(values))
        for key, (label, value) in gaps.items():
            text = f"taps {seconds:g} s: gap, {label}"
            yield Figure(f"cause_{key}_{seconds:g}s", value, "", text)
        for key in ("none", "damped", "integral"):
            if key in flown:
                label, other = flown[key]
                errors = drawn_errors(other, taps, draws, other.excited[2])
                drawn = [other.singular_values(other.g[:taps] + error) for error in errors]
                found = other.error_ratio(other.singular_values(other.estimate(seconds)), taps)
                expected = float(np.median([other.error_ratio(s, taps) for s in drawn]))
                for name, value in (("", found), ("_drawn", expected)):
                    text = f"taps {seconds:g} s: error ratio, {label}{name.replace('_', ', ')}"
                    yield Figure(f"cause_{key}_error_ratio{name}_{seconds:g}s", value, "", text)


def other_records(quick: bool) -> Iterator[Figure]:
    """Yield gap and error ratio by correlation from other records, medians of some flights."""
    kinds: dict[str, tuple[str, Callable[[int], Flight]]] = {
        "together_60s": ("60 s, all inputs at once", partial(fly, together=True)),
        "together_180s": (
            "180 s, all inputs at once",
            partial(fly, together=True, duration_s=180.0),
        ),
        "600s": ("600 s each", partial(fly, duration_s=600.0)),
        "10khz": ("60 s each at 10 kHz", partial(fly, rate_hz=10_000)),
    }
    for key in ("together_60s", "together_180s") if quick else kinds:
        label, make = kinds[key]
        seeds = 1 if quick else 5 if key.startswith("together") else 3
        flights = [make(seed) for seed in range(1, 1 + seeds)]
        for seconds in (SHORT_S,) if key == "10khz" else (SHORT_S, LONG_S):
            pairs = [(flight, flight.estimate(seconds)) for flight in flights]
            values = [f.singular_values(g) for f, g in pairs]
            ratios = [f.error_ratio(s, len(g)) for (f, g), s in zip(pairs, values, strict=True)]
            found = [
                ("gap", "gap", [gap(s) for s in values]),
                ("gap_of_6", "s(6) / s(7)", [gap(s, PLANT) for s in values]),
                ("error_ratio", "error ratio", ratios),
            ]
            if seconds == SHORT_S:
                not_scaled = [gap(f.singular_values(g, SI)) for f, g in pairs]
                found.append(("gap_si", "gap in SI units, not scaled", not_scaled))
            for name, what, each in found:
                text = f"taps {seconds:g} s: {what}, {label}"
                figure = f"record_{key}_{name}_{seconds:g}s"
                yield Figure(figure, float(np.median(each)), "", text)


def predicted(flight: Flight, quick: bool, draws: int) -> Iterator[Figure]:
    """Yield the gap predicted for other numbers of rows and taps, medians of drawn errors."""
    rate_hz = 1.0 / flight.records[0].Ts_s
    cases = [(SHORT_S, s, False) for s in (45.0, 450.0)] + [(SHORT_S, 135.0, True)]
    if not quick:
        cases += [(SHORT_S, 45.0, True), (LONG_S, 45.0, True), (LONG_S, 135.0, True)]
        cases += [(LONG_S, s, False) for s in (45.0, 450.0, 4500.0, 45_000.0)]
        cases += [(s, 450.0, False) for s in (0.2, 0.3, 0.5, 0.6, 0.8)]
    for seconds, record_s, together in cases:
        taps = flight.taps(seconds)
        errors = drawn_errors(flight, taps, draws, round(record_s * rate_hz), together)
        values = [flight.singular_values(flight.g[:taps] + error) for error in errors]
        at_once = "_together" if together else ""
        for name, each in (
            ("gap", [gap(s) for s in values]),
            ("error_ratio", [flight.error_ratio(s, taps) for s in values]),
        ):
            text = f"taps {seconds:g} s: {name.replace('_', ' ')} predicted for {record_s:g} s"
            text += ", all inputs at once" if together else " each"
            figure = f"predicted{at_once}_{name}_{seconds:g}s_{record_s:g}s"
            yield Figure(figure, float(np.median(each)), "", text)


def deviation(flight: Flight) -> Array:
    """Return the predicted standard deviation (12 s, 3, 3) of the correlation estimate."""
    return correlation_standard_deviation(flight.g, *flight.excited)


def drawn_errors(
    flight: Flight, taps: int, draws: int, rows: int, together: bool = False
) -> Iterator[Array]:
    """Yield errors (L, 3, 3) with the predicted covariance.

    The estimate is g convolved with the sample correlation matrix R of v. For white noise, R(0) has
    a diagonal of 1. All other elements are Gaussian with variance 1 / N, and R(-k) = R(k)^T. If the
    inputs are excited one at a time, elements off the diagonal do not act.
    """
    rng = np.random.default_rng(0)
    reach = taps + len(flight.g)
    fewer = np.sqrt(rows / (rows - np.arange(taps)))[:, None]  # a tap at t uses N - t rows
    inputs, own = flight.excited[1], np.arange(3)
    for _ in range(draws):
        R = rng.normal(size=(2 * reach + 1, 3, 3)) / np.sqrt(2 * rows)
        R = R + R[::-1].transpose(0, 2, 1)
        R[reach, own, own] = 0.0
        error = np.zeros((taps, 3, 3))
        for j in range(3):
            for other in range(3) if together else [j]:
                full = signal.oaconvolve(R[:, j, other, None], flight.g[:, :, other], axes=0)
                acting = inputs[other] / inputs[j] * full[reach : reach + taps]
                error[:, :, j] += fewer * acting
        yield error


def resonance_error(flight: Flight, taps: int) -> float:
    """Return the rms singular value that the error has at a resonance of decay rate a.

    sqrt(b / (N a Ts) (1 - (1 - exp(-x)) / x)) with x = b a Ts, b = L / 2 block rows and N rows.
    """
    blocks, a = taps / 2, flight.decay_1_s * flight.records[0].Ts_s
    x = blocks * a
    return float(np.sqrt(blocks / (flight.excited[2] * a) * (1.0 - (1.0 - np.exp(-x)) / x)))


def tail(g: Array, taps: int) -> Array:
    return np.concatenate([np.zeros_like(g[:taps]), g[taps:]])


def whole_periods(flight: Flight) -> Flight:
    """Return two periods of each record, after nearly one, and before the excitation fades out."""
    last = len(flight.records[0].y) - flight.taps(1.0)
    first = last - 2 * flight.taps(PERIOD_S)
    return replace(flight, records=tuple(r.rows(first, last) for r in flight.records))


def circular_correlation(flight: Flight) -> Array:
    """Return g (period, 3, 3) by correlation over whole periods of a periodic excitation."""
    g = np.empty((flight.taps(PERIOD_S), 3, 3))
    for j, record in enumerate(flight.records):
        v = record.v[:, j]
        spectrum = fft.rfft(record.y - record.y.mean(axis=0), axis=0)
        across = spectrum * fft.rfft(v).conj()[:, None]
        g[:, :, j] = fft.irfft(across, len(v), axis=0)[: len(g)] / (v @ v)
    return g


def gap(singular_values: Array, order: int = ORDER) -> float:
    return float(singular_values[order - 1] / singular_values[order])


if __name__ == "__main__":
    run("Markov parameters by correlation", measure)
