"""The numbers by which the search for effects in imported records decides, with their reasons."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SearchOptions:
    """Numbers of the search.

    blocks: blocks of time of all records together, by whose scatter an effect is judged. Fewer make
    the scatter uncertain, more make the blocks shorter than what an effect needs to show.
    fewest_blocks: in short records, of which each block needs two independent values.

    standard_errors: the mean gain of blocks that did not fit an effect, over its standard error,
    from which on it is no chance: one in 30,000, as the best of a hundred candidates is judged.

    least_gain: share of the squared missing force that an effect must take to matter (0.1 is 5 % of
    its RMS). least_free_gain: the same for a free form, which fits a little of everything.

    least_force: by how much it must lower the RMS missing force over the force of the
    inputs: below the band's limit, what a held input does between samples is known to 1 % at worst.

    alike: two effects whose gains differ by less than this many standard errors are not told apart.

    told_from_model: share of an effect's squared force that must remain beside the model's own
    parameters and the scale of all actuators; the rest is a change of these.

    worse: ratio of missing forces above which a fit with weights counts as worse than one without,
    and follows noise in the motion.

    reported: share of every record that neither fits nor chooses.

    most_effects: bound of the search. shortlisted: effects of which the nonlinear numbers are
    fitted in each round. resamples: bootstrap samples of the blocks for the support.
    """

    blocks: int = 24
    fewest_blocks: int = 8
    standard_errors: float = 4.0
    least_gain: float = 0.1
    least_free_gain: float = 0.3
    least_force: float = 0.005
    alike: float = 1.0
    told_from_model: float = 1e-3
    worse: float = 1.5
    reported: float = 0.25
    most_effects: int = 6
    shortlisted: int = 8
    resamples: int = 200
