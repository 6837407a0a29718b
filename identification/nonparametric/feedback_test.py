"""Test whether the outputs drive the inputs of records, and whether anything else does.

In a control loop that only noise excites, input and output are bound by the controller, u = -C y.
The plant fits such records, and so does y = -u / C: a black-box model of either is perfect, and
only one is the plant. Two questions, both answered by linear regressions on past rows:

- Feedback: in open loop, what is new in an output says nothing about later inputs. The regression
  of an output on the past is compared with one that has the later inputs beside it (Geweke, Meese
  and Dent, *Comparing alternative tests of causality in temporal systems*, J. Econometrics 21,
  1983). The inputs are given, so the test holds for white, periodic and constant ones alike.
- Excitation: a joint autoregression of outputs and inputs tells which part of each is the answer
  to what is new in the outputs, and which is to an input's own (Akaike, *On the use of a linear
  model for the identification of feedback systems*, Ann. Inst. Statist. Math. 20, 1968).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from ..records.record import Record

Array = NDArray[np.float64]

CHANCE = 1e-6
"""Probability by chance below which later inputs depend on an output."""
PERHAPS = 1e-3
"""The same, below which a remark asks whether a controller drives the input. Short records of a
loop whose excitation is as large as its noise do not show more."""
LEAST_DEPENDENCE = 0.025
"""Least share of an output's new part that later inputs tell. Plants with friction or coarse
readings and too few lags reach one per cent in open loop."""
LITTLE_EXCITATION = 0.3
"""Share of an input and of the outputs that excitation causes, below which a model rests on
noise."""
NOISE_SHARE = 0.05
"""Share of an input that noise causes, above which a model that simulates from it is biased."""
_MOST_LAGS, _FEWEST_LAGS, _REGRESSORS = 50, 4, 150
_ROWS_A_REGRESSOR = 4
_ROWS_A_TAP = 10
_MOST_ROWS = 12_000
_EXACT = 1e-4
"""Share of what is new in an output, beside the same row's input, that counts as rounding."""
_ROUNDING = 1e-18
"""Share of an output's variance that counts as rounding of its computation."""
_HALF = 0.5
_BEGINS, _GROWS = 0.02, (0.3, 0.75)
"""Share of its largest value with which an answer begins, and the most in this row and the next of
an answer that grows."""
_HELD = 0.5
"""Share of rows in which an input does not change, from which it is a sequence of steps."""
_PERIODIC = 1e-6
"""Share of an input that its own past does not predict, below which it is periodic."""


@dataclass(frozen=True)
class InputOrigin:
    """Where one input comes from.

    dependence: share of what is new in an output that later inputs tell, of the output with the
    most; chance: its probability without feedback. from_noise: share of the input that is the
    answer to what is new in the outputs and in other inputs; motion_from_noise: the same of the
    output with the least. Both are 0 without feedback. late: whether the answer of an input without
    excitation to the outputs begins small and grows.
    """

    name: str
    dependence: float
    chance: float
    from_noise: float = 0.0
    motion_from_noise: float = 0.0
    late: bool = False

    @property
    def fed_back(self) -> bool:
        """Whether the input depends on past outputs."""
        return self.chance < CHANCE and self.dependence > LEAST_DEPENDENCE

    @property
    def perhaps_fed_back(self) -> bool:
        """Whether the input seems to depend on past outputs, but by chance it might, too."""
        return CHANCE <= self.chance < PERHAPS and self.dependence > LEAST_DEPENDENCE

    @property
    def follows(self) -> bool:
        """Whether the input follows the outputs as a mass follows a force: a controller answers in
        its first rows. Then inputs and outputs may be exchanged."""
        return self.unexcited and self.late

    @property
    def unexcited(self) -> bool:
        """Whether the input is hardly more than the feedback of noise."""
        least = 1.0 - LITTLE_EXCITATION
        return self.fed_back and min(self.from_noise, self.motion_from_noise) > least


def input_origins(records: Sequence[Record]) -> tuple[InputOrigin, ...]:
    """Return where each input of records of one plant comes from.

    Empty for records too short for the regressions, without varying outputs, or with an input that
    never varies.
    """
    first = records[0]
    y, u = _scaled([r.y for r in records]), _scaled([r.v for r in records])
    if not np.all(np.any([np.ptp(part, axis=0) > 0.0 for part in u], axis=0)):
        return ()
    outputs = np.any([np.ptp(part, axis=0) > 0.0 for part in y], axis=0)
    p, m, rows = len(first.input_names), int(outputs.sum()), sum(map(len, y))
    width = m + 2 * p
    lags = min(_MOST_LAGS, _REGRESSORS // width, rows // (_ROWS_A_REGRESSOR * width))
    usable = [k for k in range(len(y)) if len(y[k]) > 4 * lags]
    if lags < _FEWEST_LAGS or not m or not usable:
        return ()
    y, u = [y[k][:, outputs] for k in usable], [u[k] for k in usable]
    found = []
    for j, name in enumerate(first.input_names):
        origin = InputOrigin(name, *_dependence(y, u, j, lags, first.direct))
        if origin.fed_back:
            fewer = min(lags, max(_FEWEST_LAGS, rows // (_ROWS_A_TAP * (m + p))))
            of_input, of_motion = _not_from_input(y, u, j, fewer)
            origin = replace(origin, from_noise=of_input, motion_from_noise=of_motion)
            if origin.unexcited:
                origin = replace(origin, late=_is_late(y, u, j, fewer))
        found.append(origin)
    return tuple(found)


@dataclass(frozen=True)
class FeedbackFindings:
    """What the origin of the inputs means for a model: reasons not to use it, and remarks.

    of_any: those of the reasons that hold for any model of the records, a declared one too.
    """

    doubts: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    of_any: tuple[str, ...] = ()


def feedback_findings(origins: Sequence[InputOrigin], declared: bool) -> FeedbackFindings:
    """Return what the origin of the inputs means for a model that no controller is known for.

    declared: whether the records are declared to be of a control loop.
    """
    doubts, remarks, of_any = [], [], []
    for origin in origins:
        share = f"{100.0 * origin.from_noise:.0f} %"
        if origin.follows:
            doubts.append(
                f"it looks as if inputs and outputs are exchanged: {share} of input {origin.name} "
                "is the answer to the outputs, and it comes as late as that of a mass to a force. "
                "Compare the roles of the columns in the signals file with the rig. If they are "
                "right, only noise excites this loop: add an excitation, and declare the loop"
            )
            of_any.append(doubts[-1])
        elif origin.unexcited:
            loop = "declare the controller" if declared else "declare the loop and its controller"
            doubts.append(
                f"only noise excites this loop: {share} of input {origin.name} is feedback of the "
                "outputs' noise. Such records fit the plant and also minus the inverse of the "
                "controller, so a good fit does not tell which of them the model is. Add an "
                f"excitation to {origin.name} or to the reference (white noise or a multisine), "
                f"record it with its role (excitation or reference), and {loop} in the signals "
                "file (key loop)"
            )
            of_any.append(doubts[-1])
        elif origin.fed_back and not declared:
            found = (
                f"input {origin.name} depends on past outputs, so the records are of a control "
                f"loop, but the signals file declares none. {share} of the input is feedback of "
                "the outputs' noise"
            )
            remedy = (
                "Declare the loop in the signals file (key loop; controller: unknown if you do not "
                "know it), and give the recorded reference or excitation its role"
            )
            if origin.from_noise > NOISE_SHARE:
                doubts.append(
                    f"{found}, which biases a model that simulates from the input. {remedy}"
                )
            else:
                remarks.append(f"{found}. {remedy}")
        elif origin.perhaps_fed_back and not declared:
            remarks.append(
                f"input {origin.name} may depend on past outputs (probability by chance "
                f"{origin.chance:.1g}). If a controller drives it, the model is biased: declare "
                "the loop in the signals file (key loop)"
            )
    return FeedbackFindings(tuple(doubts), tuple(remarks), tuple(of_any))


def _scaled(parts: Sequence[Array]) -> list[Array]:
    """Return the first rows of all records, without their means, over their common deviation."""
    share = min(1.0, _MOST_ROWS / max(sum(map(len, parts)), 1))
    cut = [part[: round(share * len(part))] for part in parts]
    largest = np.max([np.abs(part).max(axis=0, initial=0.0) for part in cut], axis=0)
    unit = [part / np.where(largest > 0.0, largest, 1.0) for part in cut]  # squares stay finite
    centred = [part - part.mean(axis=0) if len(part) else part for part in unit]
    size = np.sqrt(np.mean(np.vstack(centred) ** 2, axis=0))
    return [part / np.where(size > 0.0, size, 1.0) for part in centred]


def _shifted(signals: Array, shifts: Sequence[int], first: int, stop: int) -> Array:
    """Return columns of the signals so many rows later, at rows first to stop."""
    return np.hstack([signals[first + k : stop + k] for k in shifts])


def _dependence(
    y: Sequence[Array], u: Sequence[Array], j: int, lags: int, direct: bool
) -> tuple[float, float]:
    """Return the share of an output's new part that later values of input j tell, and its chance.

    direct: the outputs may answer in the row of their input, so the same row's inputs stand beside
    the past. Else they are the first of the later inputs: a controller may answer in its row.
    """
    m, p = y[0].shape[1], u[0].shape[1]
    parts = []
    for a, b in zip(y, u, strict=True):
        span = lags, len(a) - lags
        past = range(-lags, 0)
        columns = [np.ones((span[1] - span[0], 1)), _shifted(a, past, *span)]
        columns += [_shifted(b, past, *span), b[slice(*span)]]
        columns += [_shifted(b[:, [j]], range(1, lags + 1), *span), a[slice(*span)]]
        parts.append(np.hstack(columns))
    stacked = np.vstack(parts)
    R: Array = np.asarray(np.linalg.qr(stacked, mode="r"))
    alone, told = 1 + lags * (m + p), R.shape[1] - m

    def left(columns: int) -> Array:
        return np.asarray(np.sum(R[columns:, told:] ** 2, axis=0))

    new, beside, least = left(alone), left(alone + p), left(told)
    if direct and _opposes_at_once(R, m, p, lags, j) and not _is_given([b[:, j] for b in u], lags):
        direct = False
    if direct:
        if np.any(beside < _EXACT * new):  # nothing new that a later input could tell
            return 0.0, 1.0
        new, tried = beside, lags
    else:
        tried = p + lags
    told_apart = new > _ROUNDING * len(stacked)
    if not np.any(told_apart):  # outputs without noise follow from the past
        return 0.0, 1.0
    new, least = new[told_apart], np.maximum(least[told_apart], np.finfo(float).tiny)
    new = np.maximum(new, least)
    statistic = (new - least) / tried / (least / (len(stacked) - told))
    chance = m * f_distribution.sf(statistic, tried, len(stacked) - told)
    most = int(np.argmax(statistic))
    return float(1.0 - least[most] / new[most]), float(min(chance[most], 1.0))


def _opposes_at_once(R: Array, m: int, p: int, lags: int, j: int) -> bool:
    """Return whether outputs move against input j in its own row, more than in any later one.

    So does y = -u / C of a controller u = -C y. A plant with inertia answers later, and an
    accelerometer in the direction of the force. R: of the regression on the past and the same row.
    """
    alone = 1 + lags * (m + p)
    taps = np.linalg.lstsq(R[: alone + p, : alone + p], R[: alone + p, -m:], rcond=1e-10)[0]
    new, beside = (np.sum(R[k:, -m:] ** 2, axis=0) for k in (alone, alone + p))
    own = [taps[1 + m * k : 1 + m * (k + 1)] for k in reversed(range(lags))]
    start = 1 + lags * m
    driven = [taps[alone + j], *(taps[start + p * k + j] for k in reversed(range(lags)))]
    answer: list[Array] = []
    for k, force in enumerate(driven):
        answer.append(force + sum(answer[k - 1 - i] @ own[i] for i in range(k)))
    at_once, largest = answer[0], np.abs(answer).max(axis=0)
    return bool(np.any((at_once < -_HALF * largest) & (beside < _HALF * new)))


def _is_given(u: Sequence[Array], lags: int) -> bool:
    """Return whether an input shows by itself that no noise drives it: steps, or a period."""
    if np.mean(np.concatenate([np.diff(part) for part in u]) == 0.0) > _HELD:
        return True
    past = np.vstack([_shifted(part[:, None], range(-lags, 0), lags, len(part)) for part in u])
    now = np.concatenate([part[lags:] for part in u])
    left = now - past @ np.linalg.lstsq(past, now, rcond=1e-10)[0]
    return bool(np.sum(left**2) < _PERIODIC * np.sum(now**2))


def _not_from_input(
    y: Sequence[Array], u: Sequence[Array], j: int, lags: int
) -> tuple[float, float]:
    """Return the shares of input j, and of the output with the least, that are no answer to what
    is new in this input.

    What is new in the outputs comes first: it reaches the inputs of its row.
    """
    m = y[0].shape[1]
    z = [np.hstack([a, b]) for a, b in zip(y, u, strict=True)]
    X = np.vstack([_shifted(part, range(-lags, 0), lags, len(part)) for part in z])
    now = np.vstack([part[lags:] for part in z])
    taps: Array = np.asarray(np.linalg.lstsq(X, now, rcond=1e-9)[0], dtype=np.float64)
    new: Array = np.asarray(now - X @ taps, dtype=np.float64)
    at_once = np.linalg.lstsq(new[:, :m], new[:, m + j], rcond=1e-10)[0]
    new[:, m + j] = new[:, :m] @ at_once
    caused, first = np.zeros_like(now), 0
    for part in z:
        rows = slice(first, first + len(part) - lags)
        caused[rows] = _answer(taps, new[rows], lags)
        first = rows.stop
    if not np.all(np.isfinite(caused)):
        return 0.0, 0.0
    columns = [*range(m), m + j]
    left = np.sum((now - caused)[:, columns] ** 2, axis=0) / np.sum(now[:, columns] ** 2, axis=0)
    shares = np.maximum(1.0 - left, 0.0)
    return float(shares[-1]), float(shares[:-1].min())


def _is_late(y: Sequence[Array], u: Sequence[Array], j: int, lags: int) -> bool:
    """Return whether input j follows the outputs, in the same row or later, as a mass does a force.

    A controller answers at once, or after its delay. The answer of a mass begins with the square of
    the period and grows.
    """
    own = [part[:, [j]] for part in u]
    columns = []
    for a, b in zip(y, own, strict=True):
        past = _shifted(b, range(-lags, 0), lags, len(b))
        columns.append(np.hstack([_shifted(a, range(-lags, 1), lags, len(a)), past]))
    now = np.concatenate([b[lags:, 0] for b in own])
    taps = np.linalg.lstsq(np.vstack(columns), now, rcond=1e-9)[0]
    m = y[0].shape[1]
    driven = taps[: m * (lags + 1)].reshape(lags + 1, m)[::-1]
    past = taps[m * (lags + 1) :][::-1]
    answer = np.zeros((lags + 1, m))
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(lags + 1):
            answer[k] = driven[k] + past[:k] @ answer[:k][::-1]
    size = np.linalg.norm(answer, axis=1)
    largest = float(size.max())
    begin = int(np.argmax(size > _BEGINS * largest))
    grown = size[begin : begin + len(_GROWS)]
    return bool(np.isfinite(largest) and np.all(grown <= np.array(_GROWS[: len(grown)]) * largest))


def _answer(taps: Array, new: Array, lags: int) -> Array:
    """Return the answer of an autoregression, from rest, to what is new in each row."""
    rows, width = new.shape
    out = np.zeros((rows + lags, width))
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(rows):
            out[k + lags] = out[k : k + lags].reshape(-1) @ taps + new[k]
    return out[lags:]
