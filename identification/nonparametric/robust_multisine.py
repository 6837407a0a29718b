"""The robust multisine method: best linear approximation, its noise and its distortion apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..records.periodic_records import PeriodicRecord
from ..records.record import SAME_BEAM_M, IdentificationError, by_position, describe_position
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

EXCITED = 1e-6
"""A line is excited when its power is at least this share of the strongest line's."""
REPEATS_BY = 100.0
"""Least power of a line's mean over periods, over that of the scatter about it.

Commands held over skipped cycles spread over all lines, and may exceed that share at lines that
were never played; but no two periods are skipped alike: 1 is to be expected there, and 100 of
three experiments with three periods at less than one line of 10^8 (F of 6 and 12 degrees).
"""
ALIKE = 1e8
"""Condition number of the inputs' powers above which they cannot be told apart."""
TRANSIENT_P = 1e-6
"""A first period as different as this by chance still holds a transient."""
REPEATED = 0.1
"""Largest rms difference, relative to its own, of excitations that are one and the same.

Independent phases differ by sqrt(2); commands held over skipped cycles, seen at the excited lines
and averaged over periods, by some percent.
"""
SAME_LEVEL = 0.05
"""Largest difference of an input's rms, relative to its own, within one level.

Distortion grows with powers of the level: that of a cubic plant then differs by 10 %, which a few
realisations do not tell.
"""


@dataclass(frozen=True)
class BestLinearApproximation:
    """The plant as the best linear approximation H (F, m, p) at the excited lines freq_hz (F,).

    `covariance` (F, m, p, m, p), E dH[i,j] dH[k,l]^*, holds all errors of H, from the scatter over
    realisations: noise and nonlinear distortion, with `freedom` complex degrees of freedom.
    `noise_covariance` is the noise's part, from the scatter over periods, with `noise_freedom`.
    `distortion_variance` (F, m, p), at least 0, is what distortion adds to the variance of one
    realisation's estimate; it tells of the plant at this amplitude, not of how long was measured.
    With one realisation, be it flown several times, all errors are taken for noise, and the
    distortion is nan.

    For plots, rms of each line in the outputs' units (F, m): `output_level` of one experiment,
    `total_level` of what H leaves of it, `noise_level` of what noise alone leaves.
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
        """Names and units of inputs and outputs, and their sampling time."""
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
        """Return (F, m, p): the circle around H that holds the truth with this confidence.

        |dH|^2 over its estimated variance is distributed as F with 2 and 2 `freedom` degrees of
        freedom (Pintelon and Schoukens 2012, chapter 2), whose quantile has a closed form.
        """
        return np.asarray(self.standard_deviation * circle(confidence, self.freedom))

    def test(self) -> ExcessTest:
        """Return whether the scatter over realisations exceeds that over periods."""
        if not np.all(np.isfinite(self.distortion_variance)):
            nothing = np.full(self.H.shape[1], np.nan)
            return ExcessTest(nothing, nothing)
        return excess(self.total_level**2, self.noise_level**2, self.freedom, self.noise_freedom)


def best_linear_approximation(records: Sequence[PeriodicRecord]) -> BestLinearApproximation:
    """Estimate the plant from all records of one operating point, which may be one.

    At every excited line the known reference V, input U and output Y, averaged over periods, of
    all E experiments give Y V^-1 and U V^-1 by least squares (with orthogonal multisines: the mean
    over realisations of each one's p x p solution) and P = (Y V^-1)(U V^-1)^-1, which feedback
    does not bias (Pintelon and Schoukens 2012, chapters 3 and 4). What P leaves, Y - P U, scatters
    over periods with the noise alone and over experiments with noise and distortion; both variances
    of P follow to first order. As noise and distortion of all experiments are uncorrelated, all R p
    of them together give (R - 1) p degrees of freedom. Experiments that played the same, as when a
    session is flown twice, have the same distortion: they are further periods of one.

    Raises IdentificationError for records that do not fit together (sampling, periods, signals,
    position, level), inputs that are not all excited at the same lines, and lines at which inputs
    cannot be told apart.
    """
    _check_alike(records)
    first = records[0]
    spectra = _Spectra.of(records)
    excited, still = spectra.excited()
    flown, P, K, p = spectra.V.shape
    same = _numbered(spectra.V[:, :, excited].mean(axis=1))
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

    left = Y - H @ U
    answer = np.einsum("fij,epfj->epfi", H, spectra.U[:, :, excited])
    of_period = spectra.Y[:, :, excited] - answer
    noise = noise_of_mean(of_period, same)
    often = 1.0 / np.bincount(same)  # noise of an experiment's mean, relative to one flown once
    noise_weight = np.einsum("fej,fel,e->fjl", shares, shares.conj(), often / often.mean())
    freedom, noise_freedom = E - p, flown * P - E
    if freedom:
        total = np.einsum("fie,fke->fik", left, left.conj()) / freedom
        distortion = np.maximum(_diagonal(total) - _diagonal(noise), 0.0)
    else:
        total, freedom = noise, noise_freedom
        distortion = np.full(noise.shape[:2], np.nan)
    lines, f0 = np.arange(1, K + 1), 1.0 / (first.v.shape[2] * first.Ts_s)
    even, odd = _detection(lines, excited, still, H, spectra, same, f0)
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
            records, flown - E, int(np.sum(~excited & ~still)), transient_test(of_period)
        ),
    )


def at_every_position(records: Sequence[PeriodicRecord]) -> tuple[BestLinearApproximation, ...]:
    """Return the best linear approximation at each beam position (within 1 mm), ascending.

    At one position there is one for every level of the excitation, in the order of the records: a
    nonlinear plant has another one at another level. Raises IdentificationError, which names the
    position.
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
    """Return the records in groups of which each has one best linear approximation."""
    return [level for position in by_position(records) for level in _by_level(position)]


def response_estimate(bla: BestLinearApproximation) -> ResponseEstimate:
    """Return the approximation in the form that all methods share.

    Its covariance is enlarged so that sqrt(-ln 0.05) standard deviations hold 95 %, as they do with
    variances that are known, however few the degrees of freedom. The coherence of output i, the
    same for all inputs, is the share of its power that H explains.
    """
    widening = circle(0.95, bla.freedom) ** 2 / -np.log(0.05)
    power = bla.output_level**2
    unexplained = np.divide(bla.total_level**2, power, out=np.ones_like(power), where=power > 0)
    coherence = np.repeat(np.clip(1.0 - unexplained, 0.0, 1.0)[:, :, None], bla.H.shape[2], axis=2)
    return ResponseEstimate(bla.freq_hz, bla.H, coherence, widening * bla.covariance, bla.Ts_s)


@dataclass(frozen=True)
class _Spectra:
    """V, U (E, P, K, p) and Y (E, P, K, m) at lines 1 to K; |X|^2 is the sine's mean square."""

    V: Complex
    U: Complex
    Y: Complex

    @classmethod
    def of(cls, records: Sequence[PeriodicRecord]) -> _Spectra:
        """Return the spectra of all records' experiments up to the last line played."""
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
        """Return which lines (K,) all inputs excite, and which none does; else it is drowned.

        Raises IdentificationError where there is none, or where some inputs are still at lines at
        which others play.
        """
        played = _played(self.V)
        if not np.all(played.any(axis=1)):
            raise IdentificationError("expected every input to be excited, found one that is not")
        excited, loud = played.all(axis=0), _loud(self.V)
        if np.any(played & ~loud.all(axis=0)) or not np.any(excited):
            raise IdentificationError("expected all inputs to be excited at the same lines")
        return np.asarray(excited), np.asarray(~played.any(axis=0))


def _loud(V: Complex) -> NDArray[np.bool_]:
    """Return (p, K): whether V (E, P, K, p) is as strong there as a line has to be, as a rule."""
    power = np.median(np.abs(V) ** 2, axis=(0, 1)).T
    return np.asarray((power >= EXCITED * power.max(axis=1, keepdims=True)) & (power > 0))


def _played(V: Complex) -> NDArray[np.bool_]:
    """Return (p, K): whether V (E, P, K, p) is strong there, and repeats in every period."""
    mean = V.mean(axis=1)
    coherent = V.shape[1] * np.sum(np.abs(mean) ** 2, axis=0)
    scatter = np.sum(np.abs(V - mean[:, None]) ** 2, axis=(0, 1)) / (V.shape[1] - 1)
    return np.asarray(_loud(V) & (coherent >= REPEATS_BY * scatter).T)


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
    if np.linalg.cond(power / (scale[:, :, None] * scale[:, None, :])).max() > ALIKE:
        raise IdentificationError(
            "expected experiments that tell the inputs apart at every line, found inputs that play "
            f"alike in all {V.shape[2]} experiments"
        )
    return np.asarray(across @ np.linalg.inv(power))


def _numbered(V: Complex) -> Index:
    """Return (E,): the number, from 0 on, of what each experiment of V (E, F, p) plays."""
    first: list[Complex] = []
    numbers = []
    for v in V:
        size = np.sqrt(np.mean(np.abs(v) ** 2, axis=0))
        apart = [np.sqrt(np.mean(np.abs(v - other) ** 2, axis=0)) for other in first]
        same = [number for number, a in enumerate(apart) if np.all(a <= REPEATED * size)]
        if not same:
            same = [len(first)]
            first.append(v)
        numbers.append(same[0])
    return np.array(numbers, dtype=np.intp)


def _level(record: PeriodicRecord) -> Array:
    """Return the rms (p,) of every input."""
    return np.asarray(np.sqrt(np.mean(record.v**2, axis=(0, 1, 2))))


def _same_level(one: PeriodicRecord, other: PeriodicRecord) -> bool:
    a, b = _level(one), _level(other)
    return a.shape != b.shape or bool(np.all(np.abs(a - b) <= SAME_LEVEL * np.maximum(a, b)))


def _by_level(records: Sequence[PeriodicRecord]) -> list[list[PeriodicRecord]]:
    groups: list[list[PeriodicRecord]] = []
    for record in records:
        fitting = (group for group in groups if _same_level(group[0], record))
        group = next(fitting, None)
        if group is None:
            groups.append([record])
        else:
            group.append(record)
    return groups


def _detection(
    lines: NDArray[np.int_],
    excited: NDArray[np.bool_],
    still: NDArray[np.bool_],
    H: Complex,
    spectra: _Spectra,
    same: Index,
    f0: float,
) -> tuple[DetectionLines, DetectionLines]:
    """Return what even and odd lines that are still, between excited ones, show."""
    freq_hz = np.asarray(lines * f0, dtype=np.float64)
    inside = still & (lines > lines[excited][0]) & (lines < lines[excited][-1])
    even, odd = (
        detection_lines(
            freq_hz[part], freq_hz[excited], H, spectra.U[:, :, part], spectra.Y[:, :, part], same
        )
        for part in (inside & (lines % 2 == 0), inside & (lines % 2 == 1))
    )
    return even, odd


def _remarks(
    records: Sequence[PeriodicRecord], repeats: int, drowned: int, transient: ExcessTest
) -> tuple[str, ...]:
    found = [f"{r.name}: {text}" for r in records for text in r.remarks]
    if drowned:
        found.append(
            f"{drowned} lines are left out: commands held over skipped cycles drown there what "
            "some input plays"
        )
    if repeats:
        experiments = sum(len(r.v) for r in records)
        found.append(
            f"{repeats} of {experiments} experiments play what others have played: they count as "
            "further periods, not as further realisations"
        )
    if np.any(transient.p_value < TRANSIENT_P):
        found.append(
            "the first period that is used still holds a transient of the experiment before, which "
            "counts as noise: longer periods would help"
        )
    return tuple(found)


def _check_alike(records: Sequence[PeriodicRecord]) -> None:
    if not records:
        raise IdentificationError("expected at least one record of multisines, found none")
    first = records[0]
    if first.v.shape[1] < 2:
        raise IdentificationError(
            f"'{first.name}': expected two periods or more in steady state, found "
            f"{first.v.shape[1]}"
        )
    for other in records[1:]:
        for what, ours, theirs in (
            ("sampling time", first.Ts_s, other.Ts_s),
            ("period and number of periods", first.v.shape[1:], other.v.shape[1:]),
            ("way of feedback", _loop(first), _loop(other)),
            ("outputs", _named(first)[1], _named(other)[1]),
            ("inputs", _named(first)[0], _named(other)[0]),
        ):
            if ours != theirs:
                raise IdentificationError(
                    f"expected one {what}, found {ours} in '{first.name}' and {theirs} in "
                    f"'{other.name}'"
                )
        if abs((first.beam_m or 0.0) - (other.beam_m or 0.0)) > SAME_BEAM_M:
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


def _named(record: PeriodicRecord) -> tuple[str, str]:
    """Return the inputs and the outputs with their units, in words."""
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
