"""Fit the richest free form: what is left of it is what no effect of the table can explain."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from ....model.effects.base import Signals
from ...rounding import ROUNDING, TINY, basis_of
from ..search_options import SearchOptions
from .force_record import ForceModel, ForceRecord

Array = NDArray[np.float64]

_DEGREE = SearchOptions.resolved + 1
"""Of polynomials: with as many turns as are resolved."""
_TURNS = (2.0 * SearchOptions.accuracy, 2.0 * SearchOptions.least_gain)
"""Speeds at which a friction turns, over the RMS speed."""
_ALONG = SearchOptions.resolved // 2 + 1
"""Degree in the position of friction that changes along the way."""
_WIDE = SearchOptions.standard_errors
"""Range of a polynomial in standard deviations; outside it is constant."""
_ROWS_PER_NUMBER = float(SearchOptions.resolved)
"""Independent rows for each number of the free form, at least."""


def residual_of_richest(
    point: ForceModel,
    records: Sequence[ForceRecord],
    own: Sequence[Array],
    unlisted: bool = False,
) -> list[Array]:
    """Return what the model's columns `own` (C, rows, n) and a free form leave of each record.

    The form has polynomials in each position, speed and command, friction that turns at two speeds,
    and products of two signals, in each equation. It has neither the command nor the acceleration
    by itself, nor friction that grows with the command: with both free, every equation is true. So
    the force of the inputs is taken out where a law of the command and the form give it together.
    It is fitted to all records, without weights. unlisted: with friction that changes along the
    way, which the table of effects lacks.
    """
    forms = [_smoothed(r, _forms(r.signals, unlisted)) for r in records]
    held = [_of_commands(r, point) for r in records]
    laws = _laws_of_commands(records, point)
    missing = [r.varying(r.missing_force(point)) for r in records]
    inputs = [r.varying(r.input_force(point.model)) for r in records]
    left = [np.zeros_like(m) for m in missing]
    # Two rows per period of the limit are independent.
    independent = sum(2.0 * r.rows * r.band.row_s * r.band.cutoff_hz for r in records)
    for i in range(missing[0].shape[1]):
        moves = [r.moves[:, i : i + 1] for r in records]

        def column(parts: Sequence[Array], moves: Sequence[Array] = moves) -> Array:
            return np.vstack([_varying(x, m) for x, m in zip(parts, moves, strict=True)])

        commanded = _without_input(
            column(held), column([x[:, :, i].T for x in laws]), column([f[:, [i]] for f in inputs])
        )
        A = np.hstack([column(forms), commanded, column([c[:, :, i].T for c in own])])
        b = np.concatenate([m[:, i : i + 1] for m in missing])
        A = A / np.maximum(np.linalg.norm(A, axis=0), TINY)
        U, size, _ = np.linalg.svd(A, full_matrices=False)
        U = U[:, size > ROUNDING * size[0]]
        # Short records determine only some combinations: those that explain most.
        most = max(int(independent / _ROWS_PER_NUMBER), 1)
        U = U[:, np.argsort(-np.abs(U.T @ b)[:, 0])[:most]]
        # Each number takes the share of a row of what is random.
        rest = (b - U @ (U.T @ b))[:, 0] / np.sqrt(1.0 - min(U.shape[1] / independent, 0.5))
        at = 0
        for part in left:
            part[:, i] = rest[at : at + len(part)]
            at += len(part)
    return left


def _without_input(held: Array, laws: Array, force: Array) -> Array:
    """Return columns of the commands (rows, C) that do not give the force (rows, 1) of the inputs.

    laws (rows, L): of the commands, which the model has.
    """
    basis = basis_of(laws) if laws.shape[1] else laws
    rest, beyond = held - basis @ (basis.T @ held), force - basis @ (basis.T @ force)
    own = np.linalg.norm(rest, axis=0) > ROUNDING * np.linalg.norm(held, axis=0)
    inside = basis_of(rest[:, own])
    along = inside.T @ beyond
    size, given = (float(np.sum(x * x)) for x in (beyond, along))
    if size == 0.0 or size - given > SearchOptions().inexact * size:
        return held
    return np.asarray(inside @ np.linalg.qr(along, mode="complete")[0][:, 1:])


def _varying(values: Array, moves: Array) -> Array:
    """Return columns (rows, C) without the constant that fits them best where the DOF moves."""
    mean = np.sum(values * moves, axis=0) / max(float(moves.sum()), 1.0)
    return np.asarray((values - mean) * moves)


def _of_commands(record: ForceRecord, point: ForceModel) -> Array:
    """Return the columns of the form that depend on commands only (rows, C)."""
    forces = [record.force_of_command(point.model, held) for held in _held_forms(record.signals)]
    return np.hstack(forces) if forces else np.zeros((record.rows, 0))


def _laws_of_commands(records: Sequence[ForceRecord], point: ForceModel) -> list[Array]:
    """Return the forces of the model's laws of commands for each record (L, rows, n).

    Those that act in any record: another one may leave an input at zero.
    """
    found = []
    for record in records:
        changes = [record.group_changes(point, p.effect, p.shape)[:, 0] for p in point.placed]
        found.append(np.concatenate([np.zeros((0, *record.kept[0].shape)), *changes]))
    acts = np.any([forces.any(axis=(1, 2)) for forces in found], axis=0)
    return [forces[acts] for forces in found]


def foretold(
    point: ForceModel, records: Sequence[ForceRecord], own: Sequence[Array], blocks: int
) -> Array:
    """Return the RMS force that linear terms leave, and that a form of the motion leaves (2, n), of
    blocks of time that did not fit them.

    own (C, rows, n): columns of the model for each record, beside which both are fitted. blocks:
    into how many each record is cut. A random force moves all signals of a linear plant in its
    loop, but normal numbers foretell each other linearly: beyond linear terms the motion foretells
    nothing of it. Functions of the command would stand for the command, which must not be free.
    """
    missing = [r.varying(r.missing_force(point)) for r in records]
    number = np.concatenate([np.arange(r.rows) * blocks // r.rows for r in records])
    found = np.zeros((2, missing[0].shape[1]))
    kinds = ([_smoothed(r, form(r.signals)) for r in records] for form in (_linear, _of_motion))
    for (k, whole), i in product(enumerate(kinds), range(found.shape[1])):
        columns = [
            _varying(np.hstack([w, c[:, :, i].T]), r.moves[:, i : i + 1])
            for r, w, c in zip(records, whole, own, strict=True)
        ]
        A, b = np.vstack(columns), np.concatenate([m[:, i] for m in missing])
        A = A / np.maximum(np.linalg.norm(A, axis=0), TINY)
        rest = np.empty_like(b)
        for held in (number % 2 == 0, number % 2 == 1):
            rest[held] = b[held] - A[held] @ np.linalg.lstsq(A[~held], b[~held], rcond=ROUNDING)[0]
        found[k, i] = np.sqrt(np.mean(rest**2))
    return found


def _smoothed(record: ForceRecord, forces: Sequence[Array]) -> Array:
    """Return forces below the band's limit (rows, C)."""
    return np.asarray(record.band.smoothed(np.stack(forces, axis=1)))


def _linear(s: Signals) -> list[Array]:
    """Return each position and speed."""
    return [*_scaled(s.q), *_scaled(s.qd)]


def _of_motion(s: Signals) -> list[Array]:
    """Return the form without commands."""
    return _forms(s, unlisted=True, commands=False)


def _forms(s: Signals, unlisted: bool, commands: bool = True) -> list[Array]:
    motion = _linear(s)
    found = []
    for x in motion:
        found += list(_polynomials(x, _DEGREE))
    for place, speed in zip(_scaled(s.q), s.qd.T, strict=True):
        rms = max(float(speed.std()), TINY)
        for turn in _TURNS:
            rubs = np.tanh(speed / (turn * rms))
            found += [rubs, *(rubs * _polynomials(place, _ALONG) if unlisted else ())]
    every = [*motion, *(_scaled(s.acting(s.coil)) if commands else ())]
    for a in range(len(every)):
        for b in range(a):
            found.append(every[a] * every[b])
    return found


def _held_forms(s: Signals) -> list[Array]:
    found = []
    for c, command in enumerate(_scaled(s.coil)):
        for value in (*_polynomials(command, _DEGREE)[1:], np.abs(command) * command):
            found.append(value[:, None] * s.places.coil_shape[c])
        found.append(np.gradient(command)[:, None] * s.places.coil_shape[c])
    return found


def _scaled(values: Array) -> list[Array]:
    """Return each column over its range of three standard deviations, about its mean."""
    return [(x - x.mean()) / max(_WIDE * float(x.std()), TINY) for x in values.T]


def _polynomials(x: Array, degree: int) -> Array:
    return np.asarray(chebyshev.chebvander(np.clip(x, -1.0, 1.0), degree)[:, 1:].T)
