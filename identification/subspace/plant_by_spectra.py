"""Identify the plant of a known loop without a declared model: subspace, then likelihood.

The measured response gives models of every order (`frequency_subspace`). The lines of all records
then fit the one whose order the evidence prefers: the residual of the loop's response is noise plus
model error, by frequency, and both weigh (`residual_spectrum`). Feedback does not bias the result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ...model.second_order import StateSpace
from ..loop_spectra.line_weights import ALL_LINES, LineWeights
from ..loop_spectra.measured_response import last_significant, measured_response
from ..loop_spectra.output_errors import Factor
from ..loop_spectra.residual_spectrum import (
    NOT_WHITE,
)
from ..loop_spectra.spectral_lines import (
    HIGHEST_SHARE,
    LEAST_LINES,
    SEARCH_LINES,
    LoopSignals,
    point_lines,
)
from ..nonparametric.frequency_response import ResponseEstimate
from ..record_threads import record_threads
from ..records.record import IdentificationError, PiController, Record
from .fit_state_space import Directions, FitStateSpace, SampledPlant
from .frequency_subspace import frequency_subspace
from .ho_kalman import Scaling
from .local_coordinates import truncated
from .plant_from_loop import IdentifiedPlant

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

SURE = 10.0
"""Least difference of the Bayesian information criterion that counts as very strong evidence (Kass
and Raftery 1995)."""
SURE_SHARE = 4.0
"""Standard deviations of chance within which some of the lines do not decide an order."""
_ROUNDS, _STEPS = 6, 5
_AROUND, _LEAST_POINTS = 0.2, 12
"""Relative distance from a frequency within which a mode is looked for, and frequencies for it."""


@dataclass(frozen=True)
class SpectralPlant:
    """The plant and its order's evidence.

    `covariance` (n + m, n + p, n + m, n + p) of the core's [A B; C D]. `singular_values` (k,) of
    the measured response, `noise_level` the largest that noise alone has. `criteria`: Bayesian
    information criterion of the orders that were compared, less the least. `worst`: largest excess
    of a band of the residual in standard deviations of chance, at `worst_hz`. `top_hz`: end of the
    lines used.
    """

    plant: IdentifiedPlant
    covariance: Array
    singular_values: Array
    noise_level: float
    criteria: dict[int, float]
    worst: float
    worst_hz: float
    top_hz: float

    @property
    def order(self) -> int:
        """The number of the core's states."""
        return len(self.plant.core.A)

    @property
    def white(self) -> bool:
        """Whether nothing of the residual depends on the excitation, up to chance."""
        return self.worst < NOT_WHITE

    @property
    def doubtful_orders(self) -> tuple[int, ...]:
        """Other orders that the evidence does not exclude."""
        return tuple(n for n, c in sorted(self.criteria.items()) if n != self.order and c < SURE)


def plant_by_spectra(
    records: Sequence[Record],
    order: int | None = None,
    lag_pole: float = 0.0,
    least_order: int = 1,
) -> SpectralPlant:
    """Identify P from all records of one operating point and a known controller.

    The known delay and lag are taken out, so that only the states of the core remain: six for the
    rig. `order` None lets the evidence choose, from `least_order` on.

    Raises IdentificationError for records without plant input or known delay, with a constant
    output, too short, or without an excitation of every input, and for an order out of range.
    """
    for record in records:
        if record.u is None or record.leading_zeros == 0:
            missing = "the plant input" if record.u is None else "a known delay"
            raise IdentificationError(f"record '{record.name}': expected {missing}, found none")
    for name, i in zip(records[0].output_names, range(records[0].y.shape[1]), strict=True):
        if all(np.ptp(r.y[:, i]) == 0.0 for r in records):
            raise IdentificationError(f"expected every output to vary, found {name} constant")
    with record_threads() as pool:
        return _Search(records, lag_pole, pool).run(order, least_order)


class _Search:
    def __init__(self, records: Sequence[Record], lag_pole: float, pool: Executor) -> None:
        self.pool, first = pool, records[0]
        self.scaling = Scaling.of(records)
        signals = [self._scaled(r) for r in records]
        groups = _by_length(signals)
        top_hz = HIGHEST_SHARE / first.Ts_s
        self.top_hz = last_significant([measured_response(signals, first.Ts_s, top_hz)], top_hz)
        # Again, as dense as the band allows.
        response = measured_response(signals, first.Ts_s, self.top_hz)
        assert first.controller is not None
        points = [
            point_lines(
                group, {}, first.Ts_s, 0.0, self._controller(first.controller, first.Ts_s),
                (0.0, self.top_hz),
            )
            for group in groups
        ]  # fmt: skip
        found = tuple(p for p in points if p is not None)
        if not found:
            raise IdentificationError(
                f"expected at least {LEAST_LINES} lines up to {self.top_hz:.3g} Hz; record longer"
            )
        self.empty = IdentifiedPlant(_no_core(first), first.leading_zeros, lag_pole)
        self.subspace = frequency_subspace(_of_core(response, self.empty, self.top_hz))
        self.step = max(max(len(p.excited) for p in found) // SEARCH_LINES, 1)
        m, p = len(first.y[0]), len(first.v[0])
        self.lines = LineWeights(found, (np.eye(p), np.eye(m)), pool)
        numbers = 2 * m * sum(len(w.excited) * len(w.records) for w in found)
        self.price = float(np.log(numbers))

    def run(self, order: int | None, least: int) -> SpectralPlant:
        found = self.subspace
        criteria: dict[int, float] = {}
        n = order
        if n is None:
            n = min(max(found.significant, least), len(found.singular_values))
        plant = self._settled(SampledPlant(replace(self.empty, core=found.realise(n))))
        if order is None:
            plant, criteria = self._smaller(*self._larger(plant), least)
        # The error of a fit to some of the lines is beyond the noise of all: it must not weigh.
        for steps in ALL_LINES:
            self._split(plant)
            plant, factor = self._fit(plant, steps, 1)
        covariance = factor.slopes.covariance(factor)
        self._split(plant)
        worst, worst_hz = self.lines.worst
        unscaled = np.append(np.ones(len(plant.plant.core.A)), self.scaling.outputs)[:, None]
        unscaled = unscaled / np.append(np.ones(len(plant.plant.core.A)), self.scaling.inputs)
        return SpectralPlant(
            replace(plant.plant, core=self._unscaled(plant.plant.core)),
            covariance * unscaled[:, :, None, None] * unscaled,
            found.singular_values,
            found.noise_level,
            criteria,
            worst,
            worst_hz,
            self.top_hz,
        )

    def _settled(self, plant: SampledPlant) -> SampledPlant:
        """Fit and weigh in turn, until the weights no longer change the residual."""
        worst = np.inf
        for _ in range(_ROUNDS):
            self._split(plant)
            before, worst = worst, self.lines.worst[0]
            if worst > 0.9 * before or worst < NOT_WHITE:
                break
            plant, _ = self._fit(plant, 3, self.step)
        return plant

    def _larger(self, plant: SampledPlant) -> tuple[SampledPlant, dict[int, float]]:
        """Add a mode where the residual is not white, while the evidence is for it.

        The level of singular values is that of the noise at all frequencies together; a mode that
        is clear at a few is below it. Returns the criterion of an order that was tried in vain.
        """
        for _ in range(_ROUNDS):
            worst, worst_hz = self.lines.worst
            start = self._with_mode(plant, worst_hz)
            if worst < NOT_WHITE or start is None:
                break
            kept = self.lines
            more = self._settled(self._fit(start, _STEPS, self.step)[0])
            # By the weights of the larger one: in those of the other its mode is a model error.
            plant, gain = self._gain(more, plant)
            if gain >= 0.0:
                self.lines = kept
                return plant, {len(more.plant.core.A): gain}
            plant = more
        return plant, {}

    def _with_mode(self, plant: SampledPlant, freq_hz: float) -> SampledPlant | None:
        """Return the plant and the mode that its response lacks most around a frequency."""
        core, r = plant.plant.core, self.subspace.response
        near = np.abs(np.log(r.freq_hz / freq_hz)) < _AROUND
        if np.sum(near) < _LEAST_POINTS:
            return None
        left = ResponseEstimate(
            r.freq_hz[near],
            (r.H - core.response(r.freq_hz))[near],
            r.coherence[near],
            r.covariance[near],
            r.Ts_s,
        )
        mode = frequency_subspace(left).realise(2)
        return plant.with_core(
            replace(
                core,
                A=block_diag(core.A, mode.A),
                B=np.vstack([core.B, mode.B]),
                C=np.hstack([core.C, mode.C]),
            )
        )

    def _smaller(
        self, plant: SampledPlant, criteria: dict[int, float], least: int
    ) -> tuple[SampledPlant, dict[int, float]]:
        """Leave out states while the evidence is for it; a pair of them is one mode."""
        while True:
            n = len(plant.plant.core.A)
            tried = {}
            for fewer in (n - 1, n - 2):
                if fewer >= least:
                    core = truncated(plant.plant.core, fewer)
                    tried[fewer] = self._gain(plant, plant.with_core(core))
            best = max(tried, key=lambda k: tried[k][1], default=n)
            if best == n or tried[best][1] <= 0.0:
                return plant, criteria | {k: -gain for k, (_, gain) in tried.items()}
            plant, criteria = self._settled(tried[best][0]), {n: tried[best][1]}

    def _gain(self, plant: SampledPlant, start: SampledPlant) -> tuple[SampledPlant, float]:
        """Fit from another start; by how much has it a lower Bayesian information criterion?

        By some of the lines, and where chance in these could decide, by all.
        """
        step = self.step
        while True:
            problem = self._problem(step)
            (plant, _, ours), (start, _, theirs) = (
                problem.search(x, _STEPS) for x in (plant, start)
            )
            more = self._numbers(start) - self._numbers(plant)
            # A useless number lowers the sum of squares by one, with some lines and with all.
            gain = step * (ours - theirs - more) + more - more * self.price
            if step == 1 or abs(gain) > SURE_SHARE * step * np.sqrt(2.0 * abs(more)):
                return start, float(gain)
            step = 1

    def _numbers(self, plant: SampledPlant) -> int:
        n, p, m = len(plant.plant.core.A), *(len(c) for c in self.lines.correlations)
        return n * (m + p) + m * p

    def _problem(self, step: int) -> FitStateSpace:
        return FitStateSpace(self.lines.thin(step), self.pool)

    def _fit(
        self, plant: SampledPlant, steps: int, step: int
    ) -> tuple[SampledPlant, Factor[Directions]]:
        found, factor, _ = self._problem(step).search(plant, steps)
        return found, factor

    def _split(self, plant: SampledPlant) -> None:
        """Measure noise and model error anew, and weigh by them."""
        self.lines = self.lines.split(plant).by_frequency()

    def _scaled(self, r: Record) -> LoopSignals:
        assert r.u is not None
        v = r.v / self.scaling.inputs
        excited = tuple(np.flatnonzero(r.excited).tolist())
        return LoopSignals(
            r.name, r.y / self.scaling.outputs, r.u / self.scaling.inputs, v, excited
        )

    def _controller(self, controller: PiController, Ts_s: float) -> Callable[[Array], Complex]:
        scale = self.scaling.outputs / self.scaling.inputs

        def response(freq_hz: Array) -> Complex:
            C = controller.response(freq_hz, Ts_s) * scale
            return np.asarray(C[:, :, None] * np.eye(len(scale)))

        return response

    def _unscaled(self, core: StateSpace) -> StateSpace:
        inputs, outputs = self.scaling.inputs, self.scaling.outputs[:, None]
        return replace(core, B=core.B / inputs, C=core.C * outputs, D=core.D * outputs / inputs)


def _by_length(signals: Sequence[LoopSignals]) -> list[list[LoopSignals]]:
    """Return the records of one length together, the longest first."""
    lengths = sorted({len(s.y) for s in signals}, reverse=True)
    return [[s for s in signals if len(s.y) == n] for n in lengths]


def _of_core(response: ResponseEstimate, empty: IdentifiedPlant, top_hz: float) -> ResponseEstimate:
    """Return the response up to top_hz without the known delay and lag."""
    band = response.freq_hz <= top_hz
    by = 1.0 / empty.known(response.freq_hz[band])[:, None, None]
    return replace(
        response,
        freq_hz=response.freq_hz[band],
        H=response.H[band] * by,
        coherence=response.coherence[band],
        covariance=response.covariance[band] * np.abs(by)[:, :, :, None, None] ** 2,
    )


def _no_core(record: Record) -> StateSpace:
    m, p = record.y.shape[1], record.v.shape[1]
    return StateSpace(
        np.zeros((0, 0)), np.zeros((0, p)), np.zeros((m, 0)), np.zeros((m, p)), record.Ts_s
    )
