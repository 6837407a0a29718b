"""Estimate best linear approximation, noise and distortion by the robust multisine method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..records.periodic_records import PeriodicRecord
from ..records.record import (
    BEAM_POSITION_TOLERANCE_M,
    IdentificationError,
    by_position,
    describe_position,
)
from ..records.signal_names import SignalNames
from .frequency_response import ResponseEstimate, circle
from .nonlinear_distortion import (
    DetectionLines,
    ExcessTest,
    detection_lines,
    excess,
    mean_over_periods,
    noise_of_mean,
    transient_test,
)

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Index = NDArray[np.intp]

EXCITED_SHARE = 1e-6
"""A line counts as excited if its power is at least this share of the strongest line's."""
MIN_REPETITION = 100.0
"""Least power of a line's mean over periods, relative to the scatter about that mean.

Commands held over skipped cycles spread over all lines and may exceed EXCITED_SHARE at lines
without excitation, but they differ between periods: the expected ratio there is 1. With three
experiments of three periods, 100 occurs by chance at less than one line in 10^8 (F, 6 and 12
degrees of freedom).
"""
MAX_CONDITION = 1e8
"""Largest condition number of the inputs' power matrix."""
TRANSIENT_P_VALUE = 1e-6
"""Below this p-value, the first period used still contains a transient."""
REPEAT_TOLERANCE = 0.1
"""Largest relative rms difference between repetitions of one excitation.

Independent phases differ by sqrt(2); commands held over skipped cycles differ by a few percent, at
the excited lines and averaged over periods.
"""
LEVEL_TOLERANCE = 0.05
"""Largest relative difference of an input's rms within one level.

Distortion grows with powers of the level: in a cubic plant it then differs by 10 %, which a few
realisations do not resolve.
"""


@dataclass(frozen=True)
class BestLinearApproximation:
    """The best linear approximation H (F, m, p) of the plant at the excited lines freq_hz (F,).

    `covariance` (F, m, p, m, p), E dH[i,j] dH[k,l]^*, covers all errors of H, noise and nonlinear
    distortion, from the scatter over realisations, with `freedom` complex degrees of freedom.
    `noise_covariance` is the noise's part, from the scatter over periods, with `noise_freedom`.
    `distortion_variance` (F, m, p), at least 0, is the part of distortion in the variance of one
    realisation's estimate; it depends on the amplitude, not on the measuring time. With one
    realisation, even repeated, all errors count as noise, and the distortion is nan.

    For plots, rms of each line in output units (F, m): `output_level` of one experiment,
    `total_level` of the residual Y - H U, `noise_level` of noise alone.
    """

    freq_hz: Array
    H: Complex
    covariance: Complex
    noise_covariance: Complex
    distortion_variance: Array
    freedom: int
    noise_freedom: int
    output_level: Array
    total_level: Array
    noise_level: Array
    even: DetectionLines
    odd: DetectionLines
    Ts_s: float
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    beam_m: float | None
    records: tuple[str, ...]
    remarks: tuple[str, ...] = ()

    @property
    def signals(self) -> SignalNames:
        """Names and units of inputs and outputs, and the sampling time."""
        return SignalNames(
            self.input_names, self.input_units, self.output_names, self.output_units, self.Ts_s
        )

    @property
    def standard_deviation(self) -> Array:
        """Standard deviation (F, m, p) of the complex entries of H, from all errors."""
        return _deviation(self.covariance)

    @property
    def noise_deviation(self) -> Array:
        """Standard deviation (F, m, p) of the complex entries of H, from noise alone."""
        return _deviation(self.noise_covariance)

    def radius(self, confidence: float = 0.95) -> Array:
        """Return the radius (F, m, p) of the confidence circle around H.

        |dH|^2 over its estimated variance follows an F distribution with 2 and 2 `freedom` degrees
        of freedom (Pintelon and Schoukens 2012, chapter 2); its quantile has a closed form.
        """
        return np.asarray(self.standard_deviation * circle(confidence, self.freedom))

    def test(self) -> ExcessTest:
        """Test whether the scatter over realisations exceeds the scatter over periods."""
        if not np.all(np.isfinite(self.distortion_variance)):
            unknown = np.full(self.H.shape[1], np.nan)
            return ExcessTest(unknown, unknown)
        return excess(self.total_level**2, self.noise_level**2, self.freedom, self.noise_freedom)


def best_linear_approximation(records: Sequence[PeriodicRecord]) -> BestLinearApproximation:
    """Estimate the plant from all records (one or more) of one operating point.

    At every excited line, the known reference V, input U and output Y of all E experiments,
    averaged over periods, give Y V^-1 and U V^-1 by least squares, and P = (Y V^-1)(U V^-1)^-1,
    which feedback does not bias (Pintelon and Schoukens 2012, chapters 3 and 4). The residual
    Y - P U scatters over periods by noise alone, and over experiments by noise and distortion; both
    variances of P follow to first order. Noise and distortion of all experiments are uncorrelated,
    so R realisations of p experiments give (R - 1) p degrees of freedom. Repeated experiments (a
    session run twice) have the same distortion and count as further periods.

    Raises IdentificationError for records that differ in sampling, periods, signals, position or
    level, inputs that are not excited at the same lines, or linearly dependent inputs at a line.
    """
    _check_compatible(records)
    first = records[0]
    spectra = _Spectra.of(records)
    excited, silent = spectra.excited()
    flown, P, K, p = spectra.V.shape
    same = _experiment_numbers(spectra.V[:, :, excited].mean(axis=1))
    V, U, Y = (
        mean_over_periods(X[:, :, excited], same).transpose(1, 2, 0)  # (F, n, E)
        for X in (spectra.V, spectra.U, spectra.Y)
    )
    E = V.shape[2]
    inverse = _right_inverse(V)
    shares = inverse @ np.linalg.inv(U @ inverse)  # dP = sum over e of (Y - P U)[:, e] shares[e]
    H = Y @ shares
    weight = np.einsum("fej,fel->fjl", shares, shares.conj())
    one_realisation = np.einsum("fjj->fj", weight).real * (E / p)

    residual = Y - H @ U
    response = np.einsum("fij,epfj->epfi", H, spectra.U[:, :, excited])
    of_period = spectra.Y[:, :, excited] - response
    noise = noise_of_mean(of_period, same)
    inverse_repeats = 1.0 / np.bincount(
        same
    )  # noise of an experiment's mean, relative to one flown once
    noise_weight = np.einsum(
        "fej,fel,e->fjl", shares, shares.conj(), inverse_repeats / inverse_repeats.mean()
    )
    freedom, noise_freedom = E - p, flown * P - E
    if freedom:
        total = np.einsum("fie,fke->fik", residual, residual.conj()) / freedom
        distortion = np.maximum(_diagonal(total) - _diagonal(noise), 0.0)
    else:
        total, freedom = noise, noise_freedom
        distortion = np.full(noise.shape[:2], np.nan)
    lines, f0 = np.arange(1, K + 1), 1.0 / (first.v.shape[2] * first.Ts_s)
    even, odd = _detection(lines, excited, silent, H, spectra, same, f0)
    return BestLinearApproximation(
        freq_hz=lines[excited] * f0,
        H=H,
        covariance=np.einsum("fik,fjl->fijkl", total, weight),
        noise_covariance=np.einsum("fik,fjl->fijkl", noise, noise_weight),
        distortion_variance=distortion[:, :, None] * one_realisation[:, None, :],
        freedom=freedom,
        noise_freedom=noise_freedom,
        output_level=np.sqrt(np.mean(np.abs(Y) ** 2, axis=2)),
        total_level=np.sqrt(_diagonal(total)),
        noise_level=np.sqrt(_diagonal(noise)),
        even=even,
        odd=odd,
        Ts_s=first.Ts_s,
        input_names=first.input_names,
        input_units=first.input_units,
        output_names=first.output_names,
        output_units=first.output_units,
        beam_m=first.beam_m,
        records=tuple(r.name for r in records),
        remarks=_remarks(
            records, flown - E, int(np.sum(~excited & ~silent)), transient_test(of_period)
        ),
    )


def at_every_position(records: Sequence[PeriodicRecord]) -> tuple[BestLinearApproximation, ...]:
    """Return the best linear approximations at each beam position (within 1 mm), ascending.

    Each excitation level of a position has its own, in the order of the records: that of a
    nonlinear plant depends on the level. Raises IdentificationError, which names the position.
    """
    found = []
    for group in by_position_and_level(records):
        try:
            found.append(best_linear_approximation(group))
        except IdentificationError as error:
            where = describe_position(group[0].beam_m)
            raise IdentificationError(f"{where}: {error}") from None
    return tuple(found)


def by_position_and_level(records: Sequence[PeriodicRecord]) -> list[list[PeriodicRecord]]:
    """Group the records by position and excitation level."""
    return [level for position in by_position(records) for level in _by_level(position)]


def response_estimate(bla: BestLinearApproximation) -> ResponseEstimate:
    """Convert the approximation to a ResponseEstimate.

    The covariance is enlarged for few degrees of freedom so that the 95 % circle is sqrt(-ln 0.05)
    standard deviations, as with known variances. The coherence of output i, the same for all
    inputs, is the share of its power that H explains.
    """
    widening = circle(0.95, bla.freedom) ** 2 / -np.log(0.05)
    power = bla.output_level**2
    unexplained = np.divide(bla.total_level**2, power, out=np.ones_like(power), where=power > 0)
    coherence = np.repeat(np.clip(1.0 - unexplained, 0.0, 1.0)[:, :, None], bla.H.shape[2], axis=2)
    return ResponseEstimate(bla.freq_hz, bla.H, coherence, widening * bla.covariance, bla.Ts_s)


@dataclass(frozen=True)
class _Spectra:
    """V, U (E, P, K, p) and Y (E, P, K, m) at lines 1 to K; |X|^2 is a sine's mean square."""

    V: Complex
    U: Complex
    Y: Complex

    @classmethod
    def of(cls, records: Sequence[PeriodicRecord]) -> _Spectra:
        """Return the spectra of all experiments up to the last excited line."""
        N = records[0].v.shape[2]
        V = np.concatenate([_lines(r.v, (N - 1) // 2) for r in records])
        played = np.flatnonzero(_played(V).any(axis=0))
        K = int(played[-1]) + 1 if len(played) else V.shape[2]
        V = V[:, :, :K]
        U, e = V.copy(), 0
        for r in records:
            if r.u is not None:
                U[e : e + len(r.v)] += _lines(r.u - r.v, K)
            e += len(r.v)
        return cls(V, U, np.concatenate([_lines(r.y, K) for r in records]))

    def excited(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which lines (K,) all inputs excite, and which no input excites.

        The remaining lines are masked by skipped cycles. Raises IdentificationError if no line is
        excited, or if some inputs are silent at lines that others excite.
        """
        played = _played(self.V)
        if not np.all(played.any(axis=1)):
            raise IdentificationError("expected every input to be excited, found one that is not")
        excited, loud = played.all(axis=0), _loud(self.V)
        if np.any(played & ~loud.all(axis=0)) or not np.any(excited):
            raise IdentificationError("expected all inputs to be excited at the same lines")
        return np.asarray(excited), np.asarray(~played.any(axis=0))


def _loud(V: Complex) -> NDArray[np.bool_]:
    """Return (p, K): whether the median power of V (E, P, K, p) is that of an excited line."""
    power = np.median(np.abs(V) ** 2, axis=(0, 1)).T
    return np.asarray((power >= EXCITED_SHARE * power.max(axis=1, keepdims=True)) & (power > 0))


def _played(V: Complex) -> NDArray[np.bool_]:
    """Return (p, K): whether V (E, P, K, p) is loud and repeats in every period."""
    mean = V.mean(axis=1)
    coherent = V.shape[1] * np.sum(np.abs(mean) ** 2, axis=0)
    scatter = np.sum(np.abs(V - mean[:, None]) ** 2, axis=(0, 1)) / (V.shape[1] - 1)
    return np.asarray(_loud(V) & (coherent >= MIN_REPETITION * scatter).T)


def _lines(x: Array, last: int) -> Complex:
    """Return the spectra (E, P, last, n) of the periods of x (E, P, N, n) at lines 1 to `last`."""
    E, P, N, n = x.shape
    out = np.empty((E, P, last, n), complex)
    for e, experiment in enumerate(x):  # one at a time: spectra up to half the rate are large
        out[e] = fft.rfft(experiment, axis=1)[:, 1 : last + 1] * (np.sqrt(2) / N)
    return out


def _right_inverse(V: Complex) -> Complex:
    """Return V^H (V V^H)^-1 (F, E, p) of V (F, p, E); raises IdentificationError."""
    across = V.conj().transpose(0, 2, 1)
    power = V @ across
    scale = np.sqrt(np.einsum("fjj->fj", power).real)
    if np.linalg.cond(power / (scale[:, :, None] * scale[:, None, :])).max() > MAX_CONDITION:
        raise IdentificationError(
            f"expected independent inputs at every line, found inputs that are proportional in all "
            f"{V.shape[2]} experiments"
        )
    return np.asarray(across @ np.linalg.inv(power))


def _experiment_numbers(V: Complex) -> Index:
    """Number the excitations of V (E, F, p) from 0, repetitions alike; return (E,)."""
    first: list[Complex] = []
    numbers = []
    for v in V:
        size = np.sqrt(np.mean(np.abs(v) ** 2, axis=0))
        apart = [np.sqrt(np.mean(np.abs(v - other) ** 2, axis=0)) for other in first]
        same = [number for number, a in enumerate(apart) if np.all(a <= REPEAT_TOLERANCE * size)]
        if not same:
            same = [len(first)]
            first.append(v)
        numbers.append(same[0])
    return np.array(numbers, dtype=np.intp)


def _level(record: PeriodicRecord) -> Array:
    """Return the rms (p,) of every input."""
    return np.asarray(np.sqrt(np.mean(record.v**2, axis=(0, 1, 2))))


def _same_level(first: PeriodicRecord, other: PeriodicRecord) -> bool:
    a, b = _level(first), _level(other)
    return a.shape != b.shape or bool(np.all(np.abs(a - b) <= LEVEL_TOLERANCE * np.maximum(a, b)))


def _by_level(records: Sequence[PeriodicRecord]) -> list[list[PeriodicRecord]]:
    groups: list[list[PeriodicRecord]] = []
    for record in records:
        matching = (group for group in groups if _same_level(group[0], record))
        group = next(matching, None)
        if group is None:
            groups.append([record])
        else:
            group.append(record)
    return groups


def _detection(
    lines: NDArray[np.int_],
    excited: NDArray[np.bool_],
    silent: NDArray[np.bool_],
    H: Complex,
    spectra: _Spectra,
    same: Index,
    f0: float,
) -> tuple[DetectionLines, DetectionLines]:
    """Return the distortion at even and odd silent lines between the excited ones."""
    freq_hz = np.asarray(lines * f0, dtype=np.float64)
    inside = silent & (lines > lines[excited][0]) & (lines < lines[excited][-1])
    even, odd = (
        detection_lines(
            freq_hz[part], freq_hz[excited], H, spectra.U[:, :, part], spectra.Y[:, :, part], same
        )
        for part in (inside & (lines % 2 == 0), inside & (lines % 2 == 1))
    )
    return even, odd


def _remarks(
    records: Sequence[PeriodicRecord], repeats: int, masked: int, transient: ExcessTest
) -> tuple[str, ...]:
    found = [f"{r.name}: {text}" for r in records for text in r.remarks]
    if masked:
        found.append(
            f"{masked} lines are left out: there, commands held over skipped cycles mask the "
            "excitation of an input"
        )
    if repeats:
        experiments = sum(len(r.v) for r in records)
        found.append(
            f"{repeats} of {experiments} experiments repeat the excitation of others: they count "
            "as further periods, not as further realisations"
        )
    if np.any(transient.p_value < TRANSIENT_P_VALUE):
        found.append(
            "the first period used contains a transient of the experiment before, which counts as "
            "noise: use longer periods"
        )
    return tuple(found)


def _check_compatible(records: Sequence[PeriodicRecord]) -> None:
    if not records:
        raise IdentificationError("expected at least one record of multisines, found none")
    first = records[0]
    if first.v.shape[1] < 2:
        raise IdentificationError(
            f"'{first.name}': expected at least two periods in steady state, found "
            f"{first.v.shape[1]}"
        )
    for other in records[1:]:
        for what, ours, theirs in (
            ("sampling time", first.Ts_s, other.Ts_s),
            ("period and number of periods", first.v.shape[1:], other.v.shape[1:]),
            ("kind of loop", _loop(first), _loop(other)),
            ("outputs", _signal_text(first)[1], _signal_text(other)[1]),
            ("inputs", _signal_text(first)[0], _signal_text(other)[0]),
        ):
            if ours != theirs:
                raise IdentificationError(
                    f"expected one {what}, found {ours} in '{first.name}' and {theirs} in "
                    f"'{other.name}'"
                )
        if abs((first.beam_m or 0.0) - (other.beam_m or 0.0)) > BEAM_POSITION_TOLERANCE_M:
            raise IdentificationError(
                f"expected records of one position, found {describe_position(first.beam_m)} in "
                f"'{first.name}' and {describe_position(other.beam_m)} in '{other.name}'"
            )
        if not _same_level(first, other):
            ours, theirs = (", ".join(f"{x:.3g}" for x in _level(r)) for r in (first, other))
            raise IdentificationError(
                f"expected one level of every input, found rms {ours} in '{first.name}' and "
                f"{theirs} in '{other.name}'"
            )


def _signal_text(record: PeriodicRecord) -> tuple[str, str]:
    """Return the inputs and the outputs with their units, as text."""
    sides = (
        (record.input_names, record.input_units),
        (record.output_names, record.output_units),
    )
    inputs, outputs = (
        ", ".join(f"{name} [{unit}]" for name, unit in zip(names, units, strict=True))
        for names, units in sides
    )
    return inputs, outputs


def _loop(record: PeriodicRecord) -> str:
    return "an open loop" if record.u is None else "a closed loop"


def _diagonal(covariance: Complex) -> Array:
    return np.asarray(np.einsum("fii->fi", covariance).real)


def _deviation(covariance: Complex) -> Array:
    return np.asarray(np.sqrt(np.abs(np.einsum("fijij->fij", covariance))))
