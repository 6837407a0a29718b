"""Identify the declared model and the modes beside it from records in a known loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ....config.model import ModelConfig
from ....model.second_order import state_space
from ...loop_spectra.line_weights import ALL_LINES, LineWeights
from ...loop_spectra.measured_response import last_significant
from ...loop_spectra.output_errors import Factor
from ...loop_spectra.residual_spectrum import (
    NOT_WHITE,
    ResidualSpectrum,
    excess_of_bands,
)
from ...loop_spectra.spectral_lines import HIGHEST_SHARE, SEARCH_LINES, PointLines
from ...nonparametric.frequency_response import ResponseEstimate
from ...record_threads import record_threads
from ..declared_model_from_config import declared_model
from ..experiment.experiment_from_log import Experiment
from ..free_parameters import FreeParameters, free_parameters
from ..identifiability import Unidentifiable, find_unidentifiable
from ..prediction.noise_model import Noise
from .fit_with_modes import FitWithModes, ParameterSlopes
from .lines_by_point import lines_by_point, measured_responses
from .mode import Mode
from .sampled_response import LinearPlant, ParameterName, held
from .starting_modes import starting_modes

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Progress = Callable[[str, float], None]

KNOWN_TO = 0.4
"""Standard deviation of a declared value that the records do not determine, over what makes it
worth fitting: a fifth of the value where it has a sign."""
_RIGID_TIMES = 2.0
"""Modes are looked for above the declared ones times this."""
_NEARLY = 1.5
"""Cost over that of the other kind up to which a mode's kind is tried further."""
_BEYOND = 3.0
"""Frequency of the mode that stands for those above the band, over the band's end."""
_AROUND = 0.1
"""Relative distance from a mode within which its kind shows."""
_ROUNDS = 8
_EXPLAINED = 1e-4
"""Misfit over the output below which the start is near enough."""


@dataclass(frozen=True)
class LoopFit:
    """The plant, its uncertainty, and what is left.

    `names`, `covariance` (N, N) in SI units: all parameters, those of the model file first.
    `unidentifiable`: those held at declared values; the covariance counts them as known to
    KNOWN_TO. `residuals`: one for each of `points`. `worst`: largest excess of a band in standard
    deviations of chance, at `worst_hz`; `white` if it is chance.
    """

    plant: LinearPlant
    names: tuple[ParameterName, ...]
    covariance: Array
    unidentifiable: tuple[Unidentifiable, ...]
    points: tuple[PointLines, ...]
    residuals: tuple[ResidualSpectrum, ...]
    worst: float
    worst_hz: float
    noise: Noise
    steps: int

    @property
    def white(self) -> bool:
        """Whether nothing of the residual depends on the excitation, up to chance."""
        return self.worst < NOT_WHITE

    @property
    def modes(self) -> tuple[Mode, ...]:
        """The modes in the band."""
        return tuple(m for m in self.plant.modes if m.kind != "beyond")

    def mode_errors(self, mode: Mode) -> tuple[float, float]:
        """Return the standard errors of a mode's frequency in Hz and of its damping ratio."""
        k = next(i for i, m in enumerate(self.plant.modes) if m is mode)
        frequency, damping = (
            float(np.sqrt(self.covariance[i, i]))
            for i in (self.names.index((k, "omega")), self.names.index((k, "damping")))
        )
        return frequency / (2.0 * np.pi), damping


def identify_in_loop(
    config: ModelConfig,
    experiments: Sequence[Experiment],
    band_hz: tuple[float, float] | None = None,
    progress: Progress | None = None,
) -> LoopFit:
    """Fit the free parameters of `config` and the modes that the records show.

    The records are of one rate, in a known loop without moving schedule. Their residual is noise
    plus model error, by frequency (`split_residual`); both weigh. A mode bends the structure or is
    a body on it, whichever is more likely.

    Raises IdentificationError for records too short, or without excitation.
    """
    with record_threads() as pool:
        silent: Progress = lambda _what, _share: None  # noqa: E731
        return _Search(config, experiments, band_hz, progress or silent, pool).run()


class _Search:
    def __init__(
        self,
        config: ModelConfig,
        experiments: Sequence[Experiment],
        band_hz: tuple[float, float] | None,
        progress: Progress,
        pool: Executor,
    ) -> None:
        self.progress, self.pool, self.steps = progress, pool, 0
        self.parameters: FreeParameters = free_parameters(config)
        self.spread = self.parameters.worth
        self.plant = LinearPlant(declared_model(config))
        Ts_s = experiments[0].Ts_s
        if band_hz is None:
            top_hz = HIGHEST_SHARE / Ts_s
            band_hz = 0.0, last_significant(measured_responses(experiments, top_hz), top_hz)
        # Again, as dense as the band allows.
        responses = measured_responses(experiments, band_hz[1])
        points = lines_by_point(experiments, band_hz)
        excited = [len(p.excited) for p in points if any(r.excited for r in p.records)]
        self.step = max(max(excited) // SEARCH_LINES, 1)
        modes = self._starting_modes(points[0], responses, band_hz[1])
        self.plant = replace(self.plant, modes=modes)
        n, p = experiments[0].y.shape[1], experiments[0].u.shape[1]
        correlations = experiments[0].correlations or (np.eye(p), np.eye(n))
        self.lines = LineWeights(points, correlations, pool)

    def run(self) -> LoopFit:
        self._settle()
        self.lines = self.lines.split(self.plant)
        unidentifiable = self._hold()
        if self.lines.worst[0] >= NOT_WHITE:
            self.lines = self.lines.by_frequency()
            self._fit(3, self.step)
            self._choose_kinds()
        self._drop_chance()
        # The error of a fit to some of the lines is beyond the noise of all: it must not weigh.
        for steps in ALL_LINES:
            self.lines = self.lines.split(self.plant).by_frequency()
            factor = self._fit(steps, 1)
        inverse = np.linalg.inv(factor.R)
        scales = factor.slopes.scales
        covariance = scales[:, None] * (inverse @ inverse.T) * scales
        lines = self.lines = self.lines.split(self.plant)
        assert lines.noise is not None
        return LoopFit(
            self.plant,
            factor.slopes.names,
            covariance,
            tuple(unidentifiable),
            lines.points,
            lines.residuals,
            *lines.worst,
            Noise(lines.noise.force_density, lines.noise.output_covariance),
            self.steps,
        )

    def _settle(self) -> None:
        """Fit from a start that may be far off, with weights that follow the misfit down."""
        misfit = np.inf
        for _ in range(_ROUNDS):
            self.lines = self.lines.split(self.plant)
            if self.lines.misfit > 0.9 * misfit or self.lines.misfit < _EXPLAINED:
                break
            misfit = self.lines.misfit
            self.lines = self.lines.by_misfit()
            self._fit(2, self.step)

    def _problem(self, step: int) -> FitWithModes:
        return FitWithModes(self.lines.thin(step), self.parameters, self.spread, self.pool)

    def _fit(self, steps: int, step: int) -> Factor[ParameterSlopes]:
        self.progress(f"step {self.steps + 1}", 1.0 - 0.9**self.steps)
        self.plant, factor, _ = self._problem(step).search(self.plant, steps)
        self.steps += 1
        return factor

    def _hold(self) -> list[Unidentifiable]:
        """Keep parameters that the records do not determine near their declared values."""
        p = self.parameters
        count = len(p.names)
        self.lines = self.lines.by_frequency()
        free = replace(self._problem(self.step), spread=np.full(count, np.inf))
        factor = free.factor(self.plant)
        order = [*range(count, len(factor.slopes)), *range(count)]
        own = np.asarray(np.linalg.qr(factor.R[:, order], mode="r"))[-count:, -count:]
        held = find_unidentifiable(np.sqrt(self.step) * own, p.names, p.worth, p.scale)
        names = {u.name for u in held}
        self.spread = np.where([n in names for n in p.names], KNOWN_TO * p.worth, np.inf)
        return held

    def _choose_kinds(self) -> None:
        """Let modes be attached where that leaves less.

        The mode with the largest residual around it is tried first. One whose surroundings are
        white is of the right kind.
        """
        tried: set[int] = set()
        while True:
            z, freq_hz = excess_of_bands(self.lines.residuals)
            around = {
                k: float(np.max(z, where=np.abs(freq_hz / m.freq_hz - 1.0) < _AROUND, initial=0.0))
                for k, m in enumerate(self.plant.modes)
                if m.kind == "bending" and k not in tried
            }
            k = max(around, key=lambda k: around[k], default=-1)
            if k < 0 or around[k] < NOT_WHITE:
                return
            tried.add(k)
            other = self._attached(self.plant.modes[k])
            if other is None:
                continue
            problem = self._problem(self.step)
            modes = (*self.plant.modes[:k], other, *self.plant.modes[k + 1 :])
            as_bending = problem.search(self.plant, 1)
            as_attached = problem.search(replace(self.plant, modes=modes), 2)
            if as_attached[2] < _NEARLY * as_bending[2]:
                as_attached = problem.search(as_attached[0], 3)
            self.plant = min(as_bending, as_attached, key=lambda found: found[2])[0]
            self.steps += 1
            self.lines = self.lines.split(self.plant).by_frequency()

    def _drop_chance(self) -> None:
        """Leave out modes whose strength is no more than chance and model error explain.

        One of them stands for the compliance of all modes above the band. Of two modes that are
        close to each other, the weaker leaves first.
        """
        point = self.lines.points[0]
        omega = _BEYOND * 2.0 * np.pi * float(point.freq_hz[-1])
        size = point.records[0].Y.shape[1], point.records[0].U.shape[1]
        beyond = Mode("beyond", omega, 0.0, np.zeros(size))
        self.plant = replace(self.plant, modes=(*self.plant.modes, beyond))
        while self.plant.modes:
            factor = self._fit(2, self.step)
            inverse = np.linalg.pinv(factor.R)
            covariance = inverse @ inverse.T
            evidence = [self._evidence(k, factor, covariance) for k in range(len(self.plant.modes))]
            modes = self.plant.modes
            left: list[Mode] = []
            for k in np.argsort(evidence):
                beside = any(abs(m.omega / modes[k].omega - 1.0) < _AROUND for m in left)
                if evidence[k] < 0.0 and not beside:
                    left.append(modes[k])
            if not left:
                return
            kept = tuple(m for m in modes if not any(m is x for x in left))
            self.plant = replace(self.plant, modes=kept)

    def _evidence(self, k: int, factor: Factor[ParameterSlopes], covariance: Array) -> float:
        """Return by how much a mode lowers the Bayesian information criterion (Wald's test)."""
        mode = self.plant.modes[k]
        own = [i for i, name in enumerate(factor.slopes.names) if len(name) == 3 and name[0] == k]
        strength = np.array([mode.strength[i, j] for i, j in mode.entries()])
        strength /= factor.slopes.scales[own]
        wald = float(strength @ np.linalg.pinv(covariance[np.ix_(own, own)]) @ strength)
        numbers = 2 * sum(
            len(p.excited) * r.Y.shape[1] for p in self.lines.points for r in p.records if r.excited
        )
        more = 0 if mode.kind == "beyond" else 2
        return self.step * wald - (len(own) + more) * float(np.log(numbers))

    def _attached(self, mode: Mode) -> Mode | None:
        """Return the attached mode with the same resonance: strength M R M, its base at rest."""
        if mode.strength.shape[0] != mode.strength.shape[1]:
            return None
        middle = self.lines.points[len(self.lines.points) // 2]
        M = self.plant.model.at(middle.schedule).M
        strength = M @ mode.strength @ M
        strength = 0.5 * (strength + strength.T)
        share = float(np.max(np.linalg.eigvals(np.linalg.solve(M, strength)).real))
        omega = mode.omega * np.sqrt(1.0 - np.clip(share, 0.0, 0.9))
        return Mode("attached", float(omega), mode.damping, strength)

    def _starting_modes(
        self, point: PointLines, responses: Sequence[ResponseEstimate], top_hz: float
    ) -> tuple[Mode, ...]:
        if not responses:
            return ()
        at = self.plant.model.at(point.schedule)
        rigid = np.abs(np.linalg.eigvals(state_space(at).A)) / (2.0 * np.pi)
        start_hz = _RIGID_TIMES * float(rigid.max())
        Ts_s, delay_s = point.Ts_s, point.delay_s
        plain = []
        for r in responses:
            band = r.freq_hz <= top_hz
            by = 1.0 / held(at, r.freq_hz[band], Ts_s, delay_s)[1][:, None, None]
            covariance = r.covariance[band] * np.abs(by)[:, :, :, None, None] ** 2
            plain.append(
                replace(r, freq_hz=r.freq_hz[band], H=r.H[band] * by, covariance=covariance)
            )
        if np.sum(plain[0].freq_hz > start_hz) < 20:
            return ()
        return starting_modes(plain, start_hz)
