"""Estimate models of every order in closed form, as starts of the prediction-error method."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

from ...model.second_order import StateSpace
from ..nonparametric.markov_parameters import MarkovEstimate, estimate_markov
from ..records.record import IdentificationError, Record
from .ho_kalman import Decomposition, Scaling, decompose_coloured, realise
from .identify_innovation_model import StateSequence, choose_past, innovation_model, state_sequence
from .simulation import InnovationModel, fit_input_matrices, spectral_radius

PAST = (4, 6, 8, 10, 15, 20, 30, 40)


@dataclass(frozen=True)
class StartingModels:
    """Estimates from which models of every order follow.

    `markov` and `decomposition` (its Hankel matrix) are None if the excitation does not determine
    Markov parameters; `no_markov` is the reason. `sequence` has the states of the predictors.
    """

    records: tuple[Record, ...]
    markov: MarkovEstimate | None
    decomposition: Decomposition | None
    no_markov: str
    sequence: StateSequence

    def simulators(self, order: int) -> Iterator[StateSpace]:
        """Yield stable models with `order` states: by Ho-Kalman, and the predictor's.

        There are none for records of a loop: noise then reaches the inputs, and biases a model that
        simulates from them.
        """
        if self.records[0].feedback:
            return
        models = [p.model for p in self.predictors(order)]
        if self.decomposition is not None and order <= self.decomposition.orders:
            models.insert(0, realise(self.decomposition, order))
        for model in models:
            if spectral_radius(model.A) < 1.0:
                yield fit_input_matrices(model, self.records)

    def predictors(self, order: int) -> Iterator[InnovationModel]:
        """Yield the predictor with `order` states, if there is one."""
        with suppress(IdentificationError):
            yield self.predictor(order)

    def predictor(self, order: int) -> InnovationModel:
        """Return the predictor with `order` states; raises IdentificationError if none exists."""
        return innovation_model(self.sequence, order, self.records[0].Ts_s)


def starting_models(
    records: Sequence[Record], taps: int, estimator: str, most_states: int
) -> StartingModels:
    """Estimate Markov parameters of `taps` rows and the states of predictors.

    Raises IdentificationError for records that are too short for a predictor.
    """
    sequence = state_sequence(choose_past(records, PAST), records, most_states)
    try:
        markov = estimate_markov(records, taps, estimator)
        inputs = [r.v for r in records]
        decomposition = decompose_coloured(markov.g, records[0].Ts_s, Scaling.of(records), inputs)
    except IdentificationError as error:
        return StartingModels(tuple(records), None, None, str(error), sequence)
    return StartingModels(tuple(records), markov, decomposition, "", sequence)
