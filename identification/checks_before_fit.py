"""Report what records and declared model show before a fit: length, excitation, stability.

The checks take seconds for records that a fit takes minutes for.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..config.model import ModelConfig
from ..model.controller import closed_loop
from ..model.declared_model import DeclaredModel, ModelError
from ..model.second_order import discretise, lagged
from .greybox.declared_model_from_config import declared_model
from .greybox.experiment.experiment_from_log import Experiment
from .greybox.fit import unidentifiable_at_start
from .greybox.free_parameters import free_parameters
from .greybox.validation import metric_of
from .open_loop import HIGHEST_ORDER
from .options import Options
from .records.computed_outputs import computed_outputs
from .records.excitation_kind import excitations
from .records.held_out_rows import held_out_rows
from .records.persistence_of_excitation import dependent_inputs
from .records.record import IdentificationError, Record, by_position, describe_position

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

VALUES_A_NUMBER = 10
"""Least measured values for each free number. With ten, the mean square error on new data exceeds
that of the fit by (1 + 1/10) / (1 - 1/10) = 1.22 (Akaike's final prediction error)."""
FEW_STEPS = 4
"""Number of steps from which some can be fitted and others validate."""
TIME_CONSTANTS = 3.0
"""Least record length in time constants of a mode: its response has then decayed to 5 %."""
FORCE_SHARE = 0.01
"""Unknown forces over inputs (RMS) that the sensitivities allow for. Most records have more, so a
parameter that is uncertain with so little noise is uncertain in the fit."""
_INTEGRATES = 1e-3
"""Largest product of an integrator's rate and the record length: it decays by 0.1 %."""
_AT_START = "at its start values"


def check_before_fit(
    records: Sequence[Record],
    experiments: Sequence[Experiment],
    config: ModelConfig | None,
    options: Options,
) -> tuple[str, ...]:
    """Return remarks on imported data: what was found, where, what follows, and what to do.

    `records` are for the black box, `experiments` for the fit of `config` (None: no fit). The
    checks use the rows that the fits use, without the held-out ones.

    - Remarks of the import on the records: what it changed, clipped signals, a controller that is
      not the record's.
    - Inputs that do not vary, that depend on each other, or that have few frequencies.
    - Rows for each free number, and length in time constants of the slowest mode.
    - A model that is unstable or integrates without a loop, or that its controller does not
      stabilise.
    - Parameters that the records do not determine, from the sensitivities at the start values.
    """
    found: list[str] = []
    if config is not None:
        found += [text for e in experiments for text in e.contradictions]
    for source in (experiments if config is not None else (), records):
        found += [f"record '{r.name}': {text}" for r in source for text in r.remarks]
    for group in by_position(records):
        training = [r.rows(0, held_out_rows(r.y, r.v, options.holdout).start) for r in group]
        if len({(r.Ts_s, r.input_names, r.output_names) for r in training}) > 1:
            continue  # an error of the identification
        beam_m = group[0].beam_m
        where = "" if beam_m is None else f"{describe_position(beam_m)}: "
        found += [where + text for text in _of_inputs(training, options)]
        found += [where + text for text in _of_length(training, options)]
    if config is not None and experiments:
        # An error is raised again by the fit, and reported there.
        with suppress(ModelError, IdentificationError, np.linalg.LinAlgError):
            found += _of_model(config, experiments, options)
    return tuple(dict.fromkeys(found))


def _of_inputs(training: Sequence[Record], options: Options) -> Iterator[str]:
    names = training[0].input_names
    excited = np.any([r.excited for r in training], axis=0)
    for name, moves in zip(names, excited, strict=True):
        if not moves:
            yield (
                f"input {name} is constant in all rows that the fit uses: its effect cannot be "
                "identified, and there is no black-box model. Vary it in a record, or give it the "
                "role other"
            )
    for d in dependent_inputs(training):
        terms = " + ".join(f"{factor:.3g} {name}" for name, factor in d.factors.items())
        noise = f", and noise is amplified {1 / d.share:.2g} times" if d.share > 1e-6 else ""
        yield (
            f"input {d.name} depends on the other inputs: {d.name} = {terms} + constant leaves "
            f"{100 * d.share:.3g} % of it (RMS). Their effects cannot be told apart{noise}. Excite "
            f"the inputs independently, or give {d.name} the role other"
        )
    wanted = options.order or HIGHEST_ORDER
    for output in computed_outputs(training):
        if not output.of_inputs:  # else no model is recommended
            yield (
                f"{output.words}, to one part in a million: it is no measurement of its own. Leave "
                "it out, or check whether a column stands twice in the signals file"
            )
    for name, found in zip(names, excitations(training), strict=True):
        waves = found.count
        if found.kind == "periodic" and waves < wanted:
            yield (
                f"input {name} consists of {waves} sine wave{'s' * (waves > 1)} (99.9 % of its "
                f"power), which determine{'s' * (waves == 1)} {2 * waves} numbers of a transfer "
                f"function: a black-box model above order {waves} fits noise between these "
                "frequencies. Excite more frequencies by noise, a sweep or a multisine"
            )
        elif found.kind == "steps" and waves < FEW_STEPS:
            yield (
                f"input {name} consists of {waves} step{'s' * (waves > 1)}: it excites low "
                "frequencies most, and every step gives one response to fit or to validate. For "
                "fast modes or small errors, excite by noise or a multisine"
            )
        elif found.kind == "transient":
            yield (
                f"input {name} is a transient: it moves in a part of the record only, or less than "
                "twice to and fro. It excites low frequencies most. For fast modes or small "
                "errors, excite by noise or a multisine"
            )


def _of_length(training: Sequence[Record], options: Options) -> Iterator[str]:
    p, m = len(training[0].input_names), len(training[0].output_names)
    values = sum(r.y.size for r in training)

    def numbers(order: int) -> int:
        # An innovation model in canonical form: A, C with n m entries, B n p, K n m, D m p.
        return order * (2 * m + p) + m * p

    possible = [n for n in range(1, 51) if VALUES_A_NUMBER * numbers(n) <= values]
    highest, wanted = max(possible, default=0), options.order or HIGHEST_ORDER
    if highest < wanted:
        yield (
            f"the {values // m} rows that the fit uses give {VALUES_A_NUMBER} values for each free "
            f"number of a black-box model only up to order {highest}: of a higher order, the mean "
            "square error on new data exceeds that of the fit by more than 22 %. Record more "
            + ("data" if options.order is None else f"data, or choose --order {max(highest, 1)}")
        )


@dataclass(frozen=True)
class _Modes:
    """Continuous poles (1/s) of a declared model on a record, with its loop if that is known."""

    poles: Complex
    loop: bool

    @classmethod
    def of(cls, model: DeclaredModel, e: Experiment) -> _Modes:
        """Return the poles at the mean of the schedule."""
        at = model.at({name: float(values.mean()) for name, values in e.schedule.items()})
        if e.loop is None:
            return cls(np.linalg.eigvals(lagged(at).A).astype(complex), False)
        delay_s = max(at.delay_s + e.delay_cycles * e.Ts_s, 0.0)
        held = type(at)(at.M, at.D, at.K, at.B, at.force, at.lag_s, delay_s)
        closed = closed_loop(discretise(held, e.Ts_s), e.loop.controller)
        z = np.linalg.eigvals(closed).astype(complex)
        return cls(np.log(z[np.abs(z) > 1e-9]) / e.Ts_s, True)

    @property
    def largest(self) -> complex:
        """The pole with the largest real part."""
        return complex(self.poles[np.argmax(self.poles.real)])


def _of_model(
    config: ModelConfig, experiments: Sequence[Experiment], options: Options
) -> Iterator[str]:
    stops = [held_out_rows(e.y, e.u, options.holdout).start for e in experiments]
    training = [e.rows(0, stop) for e, stop in zip(experiments, stops, strict=True)]
    model = declared_model(config)
    yield from _of_numbers(config, training)
    slow: list[tuple[float, float, str]] = []
    for e, used, stop in zip(experiments, training, stops, strict=True):
        if e.moving:
            continue  # its poles change
        pole = _Modes.of(model, e)
        length_s = len(used.y) * e.Ts_s
        decay_s = [-1.0 / s.real for s in pole.poles if s.real < -_INTEGRATES / length_s]
        if decay_s and (pole.loop or not e.feedback):
            slow.append((length_s / max(decay_s), max(decay_s), e.name))
        held_out = e.rows(stop if stop < len(e.y) else 0, len(e.y))
        if pole.loop and pole.largest.real > 1.0 / length_s:
            yield (
                f"record '{e.name}': the declared controller does not stabilise the declared model "
                f"{_AT_START}: the closed loop has {_pole(pole.largest)}, but the record is "
                "bounded. Check sign, gains, units, rate and delay of the controller, and the "
                "start values. Until then a simulation may diverge, and the error is then that of "
                "predictions"
            )
        elif not e.feedback and metric_of(model, held_out) == "prediction":
            yield f"record '{e.name}': {_without_loop(pole.largest, held_out)}"
    if slow and max(slow)[0] < TIME_CONSTANTS:
        share, decay, name = max(slow)
        of = "closed loop" if any(e.loop and e.name == name for e in experiments) else "model"
        record_s = TIME_CONSTANTS * decay / (1.0 - options.holdout)
        yield (
            f"record '{name}': the rows that the fit uses last {share:.2g} time constants of the "
            f"{of}'s slowest mode ({decay:.3g} s {_AT_START}), and no record is longer. Its decay "
            "is hardly seen: the intervals of its stiffness and damping become wide. Record at "
            f"least {record_s:.3g} s, or fix these parameters"
        )
    for u in unidentifiable_at_start(config, training, FORCE_SHARE):
        apart = f" apart from {', '.join(u.together_with)}" if u.together_with else ""
        fixed = " or ".join((u.name, *u.together_with))
        yield (
            f"model '{config.name}': the records do not determine {u.name}{apart}: sensitivities "
            f"{_AT_START} give {_uncertain(u.standard_error)}. The fit holds such a parameter at "
            f"its declared value. Fix {fixed} at a known value (fixed: true), or excite "
            "the motion in which they differ"
        )


def _uncertain(standard_error: float) -> str:
    if not np.isfinite(standard_error):
        return "the same outputs for different values"
    return (
        f"a standard error of {standard_error:.2g} with unknown forces of "
        f"{100 * FORCE_SHARE:g} % of the inputs"
    )


def _of_numbers(config: ModelConfig, training: Sequence[Experiment]) -> Iterator[str]:
    n, free = len(config.dof), len(free_parameters(config).names)
    # Each record has an offset (n) and an initial state (2n); n noises act on forces, n on outputs.
    numbers, values = free + 3 * n * len(training) + 2 * n, sum(e.y.size for e in training)
    if values < VALUES_A_NUMBER * numbers:
        rows = -(-VALUES_A_NUMBER * numbers // n)
        yield (
            f"model '{config.name}': the rows that the fit uses have {values / numbers:.1f} values "
            f"for each of {numbers} free numbers ({free} parameters; offset and start of each "
            f"record, noise): below {VALUES_A_NUMBER}, the mean square error on new data exceeds "
            f"that of the fit by more than 22 %. Record at least {rows} rows, without the held-out "
            "ones, or fix parameters"
        )


def _without_loop(pole: complex, held_out: Experiment) -> str:
    length_s = len(held_out.y) * held_out.Ts_s
    if pole.real > 1.0 / length_s:
        what = f"is unstable {_AT_START}, with {_pole(pole)}"
    elif pole.real > -_INTEGRATES / length_s:
        what = f"integrates {_AT_START}"
    else:
        what = (
            f"has a time constant of {-1.0 / pole.real:.3g} s {_AT_START}, longer than the "
            f"{length_s:.3g} s of held-out rows"
        )
    return (
        f"the declared model {what}, and no loop is declared: a simulation would drift, so the "
        "error is that of predictions. If a controller drove an input, declare it in the signals "
        "file (key loop; controller: unknown if you do not know it)"
    )


def _pole(pole: complex) -> str:
    oscillates = f" at {abs(pole.imag) / (2 * np.pi):.3g} Hz" if pole.imag else ""
    return f"a pole of real part {pole.real:+.3g} 1/s{oscillates}"
