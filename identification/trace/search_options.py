"""The numbers by which the search for effects decides, each with its meaning and its reason."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.stats import norm


@dataclass(frozen=True)
class SearchOptions:
    """Numbers of the search, in prediction errors of the rig and in forces of imported records.

    Methods that no options reach, such as those that read noise or rests, use the defaults.

    standard_errors: what an effect takes of data that did not fit it, over its standard error, from
    which on it is no chance: one in 700 by itself. It is asked of the best of a hundred candidates,
    but each also has to take `least_gain`, and to keep its sign in other records.

    least_gain: share of what noise does not explain that an effect must take to matter (0.1 is 5 %
    of the RMS error): of the errors that it is fitted to, or of the free-run error of held-out
    records; of the other one of these two its square is enough. Weights may not cost as much. From
    it follow `least_free_gain` and `much_left`.

    accuracy: relative error of an equation that is right, from which follow `explained`, `inexact`,
    `alike`, `visible`, `least_force` and `told_from_model`. law_accuracy: the same of a law of
    friction that stands for another one, such as eight slip elements for twenty.

    block_s: seconds of a block of time of the rig's records, and of a segment of spectra: longer
    than the platform remembers, so that blocks are independent. blocks: blocks of time of imported
    records, by whose scatter an effect is judged. Fewer make the scatter uncertain, more make the
    blocks shorter than what an effect needs to show. In short records they are fewer, as each block
    needs two independent values.

    reported: share of all time that neither fits nor chooses.

    most_effects: bound of the search. fitted: candidates whose nonlinear numbers are fitted at
    once. patience: how many refusals in a row, detours and other ways a search tries. resamples:
    bootstrap samples of the blocks for the support.

    resolved: points by which a period, a peak or a memory is resolved. steps: of an iteration at
    most; few need as many. at_a_time: rows, columns or points that are dealt with at once.
    interpolated: rows by which a force is interpolated over a period, an even number: with 6, a
    polynomial through them is 10^-4 off at a tenth of the sampling rate.
    """

    standard_errors: float = 3.0
    least_gain: float = 0.1
    accuracy: float = 0.01
    law_accuracy: float = 0.05
    block_s: float = 4.0
    blocks: int = 24
    reported: float = 0.25
    most_effects: int = 6
    fitted: int = 10
    patience: int = 3
    resamples: int = 200
    resolved: int = 4
    steps: int = 20
    at_a_time: int = 256
    interpolated: int = 6

    @classmethod
    def chance(cls, count: int) -> float:
        """Return the standard deviations that the largest of `count` independent normal values
        exceeds as rarely as one of them exceeds `standard_errors`."""
        return float(norm.isf(norm.sf(cls.standard_errors) / count))

    @property
    def agreement(self) -> float:
        """Standard deviations of chance by which data agree with what gains `standard_errors`.

        A gain of G squared errors of unit variance has a standard error of 2 sqrt(G).
        """
        return 2.0 * self.standard_errors

    @property
    def least_free_gain(self) -> float:
        """The `least_gain` of a free form, which fits a little of everything."""
        return 2.0 * self.least_gain

    @property
    def explained(self) -> float:
        """RMS errors over those of noise alone below which records are explained."""
        return 1.0 + self.standard_errors * self.accuracy

    @property
    def explained_by_laws(self) -> float:
        """The same for laws that stand for others."""
        return 1.0 + self.standard_errors * self.law_accuracy

    @property
    def much_left(self) -> float:
        """RMS errors over those of noise alone above which an effect is missing that matters."""
        return 1.0 + self.standard_errors * self.least_gain

    @property
    def detours(self) -> int:
        """First choices that a search of imported records tries instead: its table is longer."""
        return 2 * self.patience

    @property
    def least_squares(self) -> float:
        """Squared errors of unit variance that are as much by themselves."""
        return self.agreement**2

    @property
    def inexact(self) -> float:
        """Share of the squared errors that an equation leaves of those it takes."""
        return self.accuracy**2

    @property
    def negligible(self) -> float:
        """Relative error beside which that of an equation is large."""
        return self.least_gain * self.accuracy

    @property
    def told_from_model(self) -> float:
        """Share of an effect's squared force that must remain beside the model's own parameters and
        the scale of all actuators; the rest is a change of these.

        With less, what tells the effect from them is smaller than the error of its equation.
        """
        return self.inexact

    @property
    def told_exactly(self) -> float:
        """The same of an effect whose equation has no error, as that of gravity on an arm has not.

        Of a swing of 0.3 rad, 0.01 % of the square of a sine is beside a stiffness: as much as a
        cubic stiffness has there.
        """
        return self.negligible**2

    @property
    def another_law(self) -> float:
        """The same of a law of friction in the place of another one."""
        return self.law_accuracy**2

    @property
    def alike(self) -> float:
        """Difference of two gains, over the larger one, below which both are fitted."""
        return 2.0 * self.accuracy

    @property
    def visible(self) -> float:
        """Share of what noise leaves of prediction errors that may be beyond it and mean nothing.

        It counts where the free simulation of the held-out records shows nothing any more: what is
        left is an effect that they do not show, or only one step ahead.
        """
        return 2.0 * self.accuracy

    @property
    def least_force(self) -> float:
        """Least change of the RMS missing force by an effect, over the force of the inputs.

        Below the limit of the force balance, what a held input does between samples is known to the
        accuracy of an equation at worst.
        """
        return 0.5 * self.accuracy

    @property
    def fewest_blocks(self) -> int:
        """Blocks by whose scatter an effect can just be judged."""
        return 2 * self.resolved

    @property
    def shortlisted(self) -> int:
        """Candidates that all records are asked about."""
        return self.fitted * self.most_effects

    def share_done(self, rounds: int) -> float:
        """Return the share of a trace that is done, at most, after some rounds of the search.

        Before it logs are read and the declared model is fitted, after it intervals are computed
        and unseen records are reported.
        """
        before = after = 2
        return (before + min(rounds, self.most_effects + 1)) / (before + self.most_effects + after)
