"""Say what the spectra of records in a loop tell of a fitted model: its band, and other modes."""

from __future__ import annotations

import numpy as np

from ...identification.greybox.fit_in_loop import FittedLoop
from ...identification.greybox.modes.mode import Mode
from ...identification.loop_spectra.residual_spectrum import NOT_WHITE
from ..plotting.html_page import Number, Table, Verdict
from ..plotting.number_format import interval
from ..session.session_page import listed

_KINDS = {"bending": "bending of the structure", "attached": "a body that moves on the structure"}


def loop_answer(loop: FittedLoop, name: str, rigid_hz: float, noise_most: float) -> str:
    """Return the answer: up to where to use the fitted model, and which modes it lacks.

    rigid_hz: its highest natural frequency, which a useful model covers. noise_most: up to how
    many times the noise a simulation error counts as explained.
    """
    band, modes = loop.band, loop.fit.modes
    share = f"{100.0 * band.share:g} %"
    times = f"the simulation error is {loop.over_noise:.2f} times the noise"
    if band.end_hz < rigid_hz:
        return (
            f"The fitted model '{name}' does not explain these records: from {band.end_hz:.3g} Hz "
            f"on, more than {share} of the response is not its own, and {times}."
        )
    if band.complete:
        valid = (
            f"up to {band.end_hz:.3g} Hz, as far as these records excite: its error is below "
            f"{share} of the response"
        )
    else:
        valid = f"up to {_with_bounds(loop)} Hz, where its error passes {share} of the response"
    if loop.over_noise > noise_most:
        beside = f"even with {_listed(modes)}, " if modes else ""
        return (
            f"The fitted model '{name}' does not explain these records: {beside}{times}. "
            f"It is valid {valid}.{_left(loop)}"
        )
    lacks = f" It lacks {_count(modes)}: {_listed(modes)}." if modes else ""
    if modes:
        times = f"with {'it' if len(modes) == 1 else 'them'} {times}"
    return (
        f"Use the fitted model '{name}' {valid}.{lacks} {times[0].upper()}{times[1:]}.{_left(loop)}"
    )


def loop_numbers(loop: FittedLoop, noise_most: float) -> tuple[Number, ...]:
    """Return the numbers of the summary."""
    band, good = loop.band, loop.over_noise <= noise_most
    verdict: Verdict = "good" if good else "bad"
    beside = " with the modes beside it" if loop.fit.modes else ""
    return (
        Number(
            f"{band.end_hz:.3g} Hz",
            f"end of the band in which the model is within {100.0 * band.share:g} % of the plant"
            + (", as far as the records excite" if band.complete else ""),
            "none" if not good else "good",
        ),
        Number(
            f"{loop.over_noise:.2f}",
            f"times the noise: largest simulation error{beside}, at all frequencies",
            verdict,
        ),
    )


def whiteness_words(loop: FittedLoop) -> str:
    """Return whether the residual depends on the excitation."""
    fit = loop.fit
    if fit.white:
        return (
            "No part of the residual depends on the excitation, up to chance (at most "
            f"{fit.worst:.1f} standard deviations of chance, at {fit.worst_hz:.3g} Hz)."
        )
    return (
        f"At {fit.worst_hz:.3g} Hz a part of the residual depends on the excitation "
        f"({fit.worst:.0f} standard deviations of chance; {NOT_WHITE:g} count). It weighs as an "
        "error of the model there, and the intervals include it."
    )


def modes_table(loop: FittedLoop, outputs: tuple[str, ...]) -> Table:
    """Return the modes beside the declared model, with intervals."""
    rows = []
    for mode in loop.fit.modes:
        frequency, damping = loop.fit.mode_errors(mode)
        rows.append(
            (
                interval(mode.freq_hz, frequency),
                interval(mode.damping, damping),
                _KINDS[mode.kind],
                ", ".join(f"{o} {x:+.2f}" for o, x in zip(outputs, _shape(mode), strict=True)),
            )
        )
    return Table(
        "Modes that the declared model lacks, with 95 % intervals. Shape: motion of the outputs, "
        "each over its own compliance at this frequency",
        ("frequency in Hz", "damping ratio ζ", "kind", "shape"),
        tuple(rows),
    )


def _shape(mode: Mode) -> np.ndarray:
    """Return the first left singular vector of the strength, in units that balance the outputs."""
    diagonal = np.sqrt(np.maximum(np.abs(np.diag(mode.strength)), 1e-300))
    left = np.linalg.svd(mode.strength / diagonal[:, None] / diagonal)[0][:, 0]
    size = diagonal * left
    return np.asarray(size / np.abs(size).max())


def _left(loop: FittedLoop) -> str:
    if loop.fit.white:
        return ""
    share = 100.0 * loop.unexplained
    return (
        f" At {loop.fit.worst_hz:.3g} Hz {share:.2g} % of the response comes neither from it nor "
        "from a mode: the plant is not linear there, or not the same in all records."
    )


def _with_bounds(loop: FittedLoop) -> str:
    band = loop.band
    low, high = f"{band.low_hz:.3g}", f"{band.high_hz:.3g}"
    return f"{band.end_hz:.3g}" + ("" if low == high else f" ({low} to {high})")


def _count(modes: tuple[Mode, ...]) -> str:
    return (
        "a mode that these records show"
        if len(modes) == 1
        else f"{len(modes)} modes that these records show"
    )


def _listed(modes: tuple[Mode, ...]) -> str:
    parts = []
    for kind, words in _KINDS.items():
        values = sorted(m.freq_hz for m in modes if m.kind == kind)
        if values:
            parts.append(f"{words} at {listed([f'{v:.3g}' for v in values])} Hz")
    return "; ".join(parts)
