"""Hold identification results: arrays with sampling time, names and units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..model.second_order import StateSpace
from .nonparametric.feedback_test import InputOrigin
from .nonparametric.frequency_response import ResponseEstimate
from .nonparametric.markov_parameters import MarkovEstimate
from .records.record import PiController
from .records.signal_names import SignalNames
from .subspace.held_out_simulation import HoldOut
from .subspace.plant_by_spectra import SpectralPlant
from .subspace.plant_from_loop import IdentifiedPlant
from .subspace.response_uncertainty import ModelResponse, Modes
from .subspace.simulation import InnovationModel

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class SubspacePoint:
    """The plant at one operating point by the subspace method, with standard errors.

    `found` has the plant, its covariance and the evidence for its order. `response` is P at the
    frequencies of the point, `modes` are the core's poles. `doubts` lists reasons not to use the
    model.
    """

    found: SpectralPlant
    response: ModelResponse
    modes: Modes
    holdout: tuple[HoldOut, ...]
    doubts: tuple[str, ...] = ()

    @property
    def plant(self) -> IdentifiedPlant:
        """The plant."""
        return self.found.plant

    @property
    def order(self) -> int:
        """The number of the core's states."""
        return self.found.order

    @property
    def trusted(self) -> bool:
        """Whether there is no reason not to use the model."""
        return not self.doubts


@dataclass(frozen=True)
class ClosedLoopPoint:
    """The plant at one operating point, from records in a loop with a known controller.

    `markov` and `singular_values` have one entry for each estimator: of the loop G from v to y, and
    of its Hankel matrix without known delay and lag; `noise_levels` are the largest singular values
    that the errors of the Markov parameters have. `loop` is the realised model of that loop, of
    `order` states; `plant` follows from it by (14). All responses of P are at freq_hz (F,): of
    `plant`, of (14) applied to the Markov parameters at each frequency, of (15), and of the joint
    estimate.
    `doubts` lists reasons not to use `loop`, `plant` and their simulations; the other responses are
    not affected. `subspace` is the plant by that method; if None, `remarks` gives the reason.
    """

    beam_m: float | None
    records: tuple[str, ...]
    controller: PiController
    markov: Mapping[str, MarkovEstimate]
    singular_values: Mapping[str, Array]
    noise_levels: Mapping[str, float]
    order: int
    loop: StateSpace
    plant: IdentifiedPlant
    freq_hz: Array
    from_ho_kalman: Complex
    from_markov: Complex
    from_sensitivity: ResponseEstimate
    from_joint: ResponseEstimate
    sensitivity: ResponseEstimate
    loop_coherence: Array
    holdout: tuple[HoldOut, ...]
    remarks: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    subspace: SubspacePoint | None = None

    @property
    def trusted(self) -> bool:
        """Whether there is no reason not to use the realised model."""
        return not self.doubts

    @property
    def recommended(self) -> IdentifiedPlant | None:
        """The plant to use: the subspace model if trusted, else Ho-Kalman's if trusted, else None.

        From the same records, the subspace method has smaller errors and states them.
        """
        if self.subspace is not None and self.subspace.trusted:
            return self.subspace.plant
        return self.plant if self.trusted else None


@dataclass(frozen=True)
class ImpulseLength:
    """The number of Markov parameters, and how it was chosen.

    `chosen_by`: validation, given, or rule (the longest candidate, if the excitation determines
    none of them). `validation_error`: error over the outputs' rms on the last quarter of the
    training rows, by number of taps; empty without validation.
    """

    taps: int
    Ts_s: float
    chosen_by: Literal["validation", "given", "rule"]
    validation_error: Mapping[int, float]

    @property
    def length_s(self) -> float:
        """Length in s."""
        return self.taps * self.Ts_s


@dataclass(frozen=True)
class OpenLoopPoint:
    """A system from its input to its output, from records without a known controller.

    `model` (of `order`) simulates, `predictor` (of `predictor_order`) predicts one step ahead; both
    are fitted by the prediction-error method. `covariance` (n + m, n + p, n + m, n + p) is the
    error covariance of [A B; C D] of `model`; `response` and `modes` follow from it. If not
    `stable`, no stable model simulates the records: `model` is the predictor's. The orders are the
    smallest ones whose validation error is not significantly above the minimum. `validation_error`
    (orders,) is the error on the last quarter of the training rows over the outputs' rms; nan where
    no model was fitted.
    """

    beam_m: float | None
    records: tuple[str, ...]
    markov: Mapping[str, MarkovEstimate]
    singular_values: Mapping[str, Array]
    impulse: ImpulseLength
    order: int
    predictor_order: int
    validation_error: Array
    predictor_validation_error: Array
    model: StateSpace
    covariance: Array
    stable: bool
    modes: Modes
    predictor: InnovationModel
    predictor_modes: Modes
    response: ModelResponse
    from_spectra: ResponseEstimate
    holdout: tuple[HoldOut, ...]
    remarks: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    origins: tuple[InputOrigin, ...] = ()
    feedback: bool = False
    """Whether the records are declared to be of a control loop."""

    @property
    def trusted(self) -> bool:
        """Whether there is no reason not to use the model."""
        return not self.doubts


@dataclass(frozen=True)
class IdentificationResult:
    """All operating points of a set of logs, and the reasons for logs left out."""

    signals: SignalNames
    points: tuple[ClosedLoopPoint | OpenLoopPoint, ...]
    skipped: tuple[str, ...] = field(default=())
