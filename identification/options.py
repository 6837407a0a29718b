"""What a user may decide about an identification."""

from __future__ import annotations

from dataclasses import dataclass

from .nonparametric.markov_parameters import ESTIMATORS
from .records.record import IdentificationError

LOOP_IMPULSE_S = 8.0  # the integrators' mode decays in 1.15 s: after 6 s it still biases by 0.2 %
LOOP_SEGMENT_S = 10.0


@dataclass(frozen=True)
class Options:
    """Choices of an identification; what is None follows from the data.

    markov: estimator of the Markov parameters (markov.ESTIMATORS) that the model is made from.
    order: states of the realised model; None for the largest gap of the singular values in a loop,
    and by validation without. impulse_s: length of the impulse response (None: 8 s in a loop, more
    while it has not decayed, less for short records, else as many taps as leave 4 rows each).
    segment_s: segments of the spectra (None: 10 s in a loop, less for short records, else an eighth
    of the longest record). holdout: share of every record, its end, that only checks the model.
    lag_s: known first-order lag of the inputs (the declared model's current loop), taken out of the
    loop before it is realised.
    """

    markov: str = "least_squares"
    order: int | None = None
    impulse_s: float | None = None
    segment_s: float | None = None
    holdout: float = 0.25
    lag_s: float = 0.0

    def __post_init__(self) -> None:
        if self.markov not in ESTIMATORS:
            raise IdentificationError(
                f"expected a Markov estimator out of {', '.join(sorted(ESTIMATORS))}, "
                f"found '{self.markov}'"
            )
        if not 0.0 <= self.holdout <= 0.5:
            raise IdentificationError(f"expected a holdout of 0 to 0.5, found {self.holdout:g}")
        for name in ("impulse_s", "segment_s"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise IdentificationError(f"expected a positive {name}, found {value:g}")

    def holdout_rows(self, rows: int) -> int:
        """Return how many of `rows` rows are kept for checking."""
        return round(self.holdout * rows)
