"""Say what the spectra of records in a loop tell of a fitted model: its band, and other modes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...identification.greybox.fit_in_loop import FittedLoop
from ...identification.greybox.modes.mode import Mode
from ...identification.greybox.modes.mode_shapes import ModeShape
from ...identification.loop_spectra.residual_spectrum import NOT_WHITE
from ...identification.subspace.response_uncertainty import SURE_95
from ..figures.mode_shapes import DrawnShape, mode_shapes
from ..plotting.figure_to_svg import Picture, to_svg
from ..plotting.html_page import Number, Part, Table, Text, Verdict
from ..plotting.number_format import interval
from ..plotting.style import signed
from ..session.session_page import listed

_SINGLE = 0.5
"""Share of what the sensors show below which it is no single shape."""
_LITTLE = 5.0
"""Percent of a shape below which it is rigid, up to its errors."""
_SHORT = {"bending": "bending", "attached": "a body's motion"}
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
    for mode, shape in loop.modes:
        frequency, damping = loop.fit.mode_errors(mode)
        rows.append(
            (
                interval(mode.freq_hz, frequency),
                interval(mode.damping, damping),
                _KINDS[mode.kind],
                ", ".join(map(_of_output, outputs, _shape(mode).tolist())),
                "—" if shape is None else f"{100.0 * shape.beyond_wrench:.3g} %",
            )
        )
    return Table(
        "Modes that the declared model lacks, with 95 % intervals. Shape: motion of the outputs, "
        "each over its own compliance at this frequency. Unseen: share of the squared motion of "
        "the sensors that is beyond rigid motion, so that the outputs do not have it",
        ("frequency in Hz", "damping ratio ζ", "kind", "shape", "unseen"),
        tuple(rows),
    )


def shape_parts(loop: FittedLoop) -> tuple[Part, ...]:
    """Return the picture of the modes' shapes, and whether the coils reach them."""
    seen = [(mode, shape) for mode, shape in loop.modes if shape is not None]
    if not seen:
        return ()
    drawn = [
        DrawnShape(f"{mode.freq_hz:.4g} Hz, {_SHORT[mode.kind]}", shape) for mode, shape in seen
    ]
    where = listed([f"{mode.freq_hz:.3g} Hz" for mode, _ in seen])
    within = listed([f"{SURE_95 * float(shape.se.max()):.2g}" for _, shape in seen])
    picture = Picture(
        "mode-shapes",
        to_svg(mode_shapes(drawn)),
        f"Shapes of the modes at {where} on the platform.",
        "Motion at each sensor over the largest, from the spectra of the single sensors around "
        f"each mode; 95 % within ± {within}. Above: grey at rest, coloured moved. Below: from "
        "above, x to the right, y up.",
    )
    return picture, Text(" ".join([_reciprocity(seen), *(_drive(*one) for one in seen)]).strip())


def _reciprocity(seen: Sequence[tuple[Mode, ModeShape]]) -> str:
    """Return why the sensors tell what the coils reach, and how well the measured drive agrees."""
    if any(shape.reach is None for _, shape in seen):
        return "Whether the coils reach these modes is unknown, as no sensors are at their places."
    least = 100.0 * min(shape.agreement for _, shape in seen)
    return (
        "Sensors are at the coils' places, so by reciprocity each coil drives a mode as much as "
        "its sensor sees of it; the measured drive by the wrench agrees with that to "
        f"{least:.3g} % or more."
    )


def _drive(mode: Mode, shape: ModeShape) -> str:
    """Return which coils reach a mode, and whether they do so without a wrench."""
    where = f"{mode.freq_hz:.3g} Hz"
    if shape.single < _SINGLE:
        return (
            f"{where}: only {100.0 * shape.single:.2g} % of what the sensors show has one shape; "
            "another mode may be close to it."
        )
    if shape.reach is None:
        return ""
    coil = int(np.argmax(np.abs(shape.reach)))
    unseen = 100.0 * shape.beyond_wrench
    if unseen < _LITTLE:
        return f"{where}: coil {coil} most; only the wrench drives it."
    return (
        f"{where}: coil {coil} most; {unseen:.2g} % of the squared drive is in forces that have no "
        "wrench."
    )


def _of_output(name: str, motion: float) -> str:
    return f"{name} {signed(motion, 2)}"


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
