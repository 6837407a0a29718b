"""Define the options of an identification."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp

from .nonparametric.markov_parameters import ESTIMATORS
from .records.record import IdentificationError

LOOP_IMPULSE_S = 8.0  # the integrators' mode decays in 1.15 s: 6 s still gives a bias of 0.2 %
LOOP_SEGMENT_S = 10.0


@dataclass(frozen=True)
class Options:
    """Options of an identification; None: chosen from the data.

    markov: estimator of the Markov parameters (markov_parameters.ESTIMATORS).
    order: states of the realised model. None: the largest ratio of neighbouring singular values in
    closed loop, validation in open loop.
    impulse_s: length of the impulse response in s. None: 8 s in closed loop (longer until it has
    decayed, shorter for short records), validation in open loop.
    segment_s: segments of the spectra in s. None: 10 s in closed loop (shorter for short records),
    an eighth of the longest record in open loop.
    holdout: share of every record, at its end, that is held out to check the model.
    lag_s: known first-order lag of the inputs in s (current loop), removed before the realisation.
    band_hz: lowest and highest frequency that the fit of the declared model to a rig's records
    uses. None: up to where the excitation still shows above the noise.
    """

    markov: str = "least_squares"
    order: int | None = None
    impulse_s: float | None = None
    segment_s: float | None = None
    holdout: float = 0.25
    lag_s: float = 0.0
    band_hz: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.markov not in ESTIMATORS:
            raise IdentificationError(
                f"markov: expected one of the estimators {', '.join(sorted(ESTIMATORS))}, "
                f"found '{self.markov}'"
            )
        if not 0.0 <= self.holdout <= 0.5:
            raise IdentificationError(
                f"holdout: expected a share of 0 to 0.5, found {self.holdout:g}"
            )
        if self.band_hz is not None and not 0.0 <= self.band_hz[0] < self.band_hz[1]:
            raise IdentificationError(
                "band: expected two frequencies in Hz, the lower one first, found "
                f"{self.band_hz[0]:g} and {self.band_hz[1]:g}"
            )
        for name in ("impulse_s", "segment_s"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise IdentificationError(
                    f"{name}: expected a positive duration in s, found {value:g}"
                )

    def lag_pole(self, Ts_s: float) -> float:
        """Return the pole of the sampled lag, 0 without one."""
        return exp(-Ts_s / self.lag_s) if self.lag_s > 0 else 0.0

    def holdout_rows(self, rows: int) -> int:
        """Return the number of held-out rows in a record of `rows` rows."""
        return round(self.holdout * rows)
