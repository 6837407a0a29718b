"""Compute the excitation of a record block by block: one of hours is never in memory as a whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...config.base import ConfigError
from ...config.session import RecordStep, SessionConfig
from .excitation import fade, signal
from .orthogonal_multisine import orthogonal_multisines

Array = NDArray[np.float64]

_ROWS = 1 << 14
_AXIS = {"psi": 0, "theta": 1, "z": 2}


@dataclass(frozen=True)
class ExcitedBlock:
    """Hold the samples (rows,) of each excited axis (N m, N m, N) and coil (N) from `first` on."""

    first: int
    rows: int
    axes: dict[int, Array]
    coils: dict[int, Array]

    def wrench(self, shape: Array) -> Array:
        """Return the block as a wrench (rows, 3); `shape` (C, 3) is that of the coils."""
        wrench = np.zeros((self.rows, 3))
        for axis, samples in self.axes.items():
            wrench[:, axis] += samples
        for coil, samples in self.coils.items():
            wrench += samples[:, None] * shape[coil]
        return wrench

    def coil_squares(self, T_coils: Array) -> Array:
        """Return the sum of the squared forces of each coil (C,) in N^2 over the block.

        T_coils (3, C) shares out a wrench. The forces of all coils are never in memory.
        """
        axes = list(self.axes)
        v = np.stack(list(self.axes.values())) if axes else np.zeros((0, self.rows))
        T = T_coils[axes]
        squares = np.asarray(np.sum(T * (v @ v.T @ T), axis=0))
        for coil, samples in self.coils.items():
            squares[coil] += samples @ samples + 2.0 * (v @ samples) @ T[:, coil]
        return squares


@dataclass(frozen=True)
class RecordExcitation:
    """The excitation of one record of a session, `cycles` cycles on a rig with `coils` coils.

    `index` is the number of its step; `source` and `where` name session and step in errors.
    """

    session: SessionConfig
    step: RecordStep
    index: int
    cycles: int
    rate_hz: float
    coils: int
    source: str
    where: str

    def blocks(self) -> Iterator[ExcitedBlock]:
        """Yield consecutive blocks that cover the record; none without excitation.

        Raises:
            ConfigError: an excitation does not fit the rate, its band or the rig.
        """
        played = [self._input(name) for name in self.step.excite]
        signals = self._signals()
        for first in range(0, self.cycles if played else 0, _ROWS):
            end = min(first + _ROWS, self.cycles)
            block = ExcitedBlock(first, end - first, {}, {})
            places = [(block.axes if is_axis else block.coils, n) for is_axis, n in played]
            for part, number in places:
                part.setdefault(number, np.zeros(block.rows))
            for one in signals:
                begin, until = max(first, one.begin), min(end, one.begin + one.cycles)
                if begin >= until:
                    continue
                samples = self._samples(one, begin - one.begin, until - one.begin)
                for position, column in zip(one.positions, samples.T, strict=True):
                    part, number = places[position]
                    part[number][begin - first : until - first] += column
            yield block

    def arrays(self) -> tuple[Array, Array]:
        """Return v (n, 3) and coil excitation (n, C); a single row of zeros without excitation."""
        v, coils = np.zeros((1, 3)), np.zeros((1, self.coils))
        for block in self.blocks():
            during = slice(block.first, block.first + block.rows)
            if block.axes and len(v) != self.cycles:
                v = np.zeros((self.cycles, 3))
            if block.coils and len(coils) != self.cycles:
                coils = np.zeros((self.cycles, self.coils))
            for axis, samples in block.axes.items():
                v[during, axis] = samples
            for coil, samples in block.coils.items():
                coils[during, coil] = samples
        return v, coils

    def peak_n(self, T_coils: Array, passed: Callable[[int], None] = lambda _: None) -> float:
        """Return an upper bound of the force of a coil in N; T_coils (3, C) shares out a wrench.

        `passed` is called with the number of cycles in each block that is done.
        """
        axes = coils = 0.0
        with np.errstate(over="ignore", invalid="ignore"):  # a peak of inf or nan says it
            for block in self.blocks():
                for samples in block.coils.values():
                    coils = _larger(coils, samples)
                if len(block.axes) == 1:  # the usual case needs no product
                    ((axis, samples),) = block.axes.items()
                    axes = _larger(axes, samples, float(np.abs(T_coils[axis]).max()))
                elif block.axes:
                    v = np.stack(list(block.axes.values()), axis=1)
                    axes = _larger(axes, v @ T_coils[list(block.axes)])
                passed(block.rows)
        return axes + coils

    def _samples(self, one: _Signal, first: int, end: int) -> Array:
        """Return the next samples (m, p) of a signal, faded."""
        window = fade(first, end, one.cycles, self.step.fade_s, self.rate_hz)
        try:
            samples = one.read(end - first)
        except ConfigError as error:
            name = self.step.excite[one.positions[0]]
            raise ConfigError(f"{self.source}: excitations.{name}.{error}") from None
        return np.asarray(self.step.scale * samples * window[:, None])

    def _input(self, name: str) -> tuple[bool, int]:
        """Return whether an excitation plays at an axis, not a coil, and the number of either."""
        played = self.session.excitations[name].input
        if played in _AXIS:
            return True, _AXIS[played]
        coil = int(played.removeprefix("coil:"))
        if coil >= self.coils:
            raise ConfigError(
                f"{self.where}: excitation '{name}': expected coil:0 .. coil:{self.coils - 1}, "
                f"found {played}"
            )
        return False, coil

    def _signals(self) -> list[_Signal]:
        """Return the signals of the record: one of all excitations together, or one of each."""
        step, rate_hz, seed = self.step, self.rate_hz, self.session.seed
        played = [self.session.excitations[name] for name in step.excite]
        if step.orthogonal is not None:
            blocks = orthogonal_multisines(played, step.orthogonal, rate_hz, seed, self.index)
            return [_Signal(blocks, tuple(range(len(played))), 0, self.cycles)]
        each, cycles = 0, self.cycles
        if step.each_s is not None:  # each excitation fades out while the next one fades in
            each = cycles_of(step.each_s, rate_hz)
            cycles = each + cycles_of(step.fade_s, rate_hz)
        found = []
        for position, excitation in enumerate(played):
            # One random stream per record and excitation: a new record does not change the others.
            rng = np.random.default_rng([seed, self.index, position])
            blocks = signal(excitation, cycles, rate_hz, rng)
            found.append(_Signal(blocks, (position,), position * each, cycles))
        return found


@dataclass
class _Signal:
    """Read the `cycles` samples, from cycle `begin` on, of the excitations at `positions`."""

    blocks: Iterator[Array]
    positions: tuple[int, ...]
    begin: int
    cycles: int
    left: Array = field(default_factory=lambda: np.zeros(0))

    def read(self, rows: int) -> Array:
        """Return the next samples (rows, p)."""
        parts: list[Array] = []
        found = 0
        while found < rows:
            if not len(self.left):
                self.left = next(self.blocks)
            part, self.left = self.left[: rows - found], self.left[rows - found :]
            parts.append(part)
            found += len(part)
        return np.concatenate(parts).reshape(rows, len(self.positions))


def cycles_of(duration_s: float, rate_hz: float) -> int:
    """Return the cycles of a duration; at least one if it is positive."""
    return max(round(duration_s * rate_hz), 1 if duration_s > 0.0 else 0)


def _larger(peak: float, samples: Array, scale: float = 1.0) -> float:
    """Return the peak or that of scaled samples, nan if either is nan."""
    return float(np.max([peak, scale * samples.max(), -scale * samples.min()]))
