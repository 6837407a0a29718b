"""Draw data sets that somebody may hand to `identify` and `trace`, sensible and absurd ones.

A case is a plant (a chain of masses), a way to excite it, a fault of the data and the files that
describe them. `cannot` says why no model can be had from the data, if so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.linalg import expm

Array = NDArray[np.float64]
Generator = np.random.Generator

_UNITS = {"m": ("um", "mm", "km"), "N": ("mN", "kN", "lbf")}
_BOUNDS = {"min": 1e-9, "max": 1e9}


@dataclass(frozen=True)
class DataRecord:
    """Inputs u (N, p) and outputs y (N, n) in the units of the file."""

    u: Array
    y: Array
    rate_hz: float


@dataclass(frozen=True)
class Case:
    """Records with one SIGNALS.yaml each, and a MODEL.yaml; None: there is none.

    excitation, fault, loop: what was drawn; cannot: why no model can be had, empty if it can.
    """

    seed: int
    excitation: str
    fault: str
    loop: str
    cannot: str
    records: tuple[DataRecord, ...]
    signals: tuple[Mapping[str, Any], ...]
    model: Mapping[str, Any] | None

    @property
    def text(self) -> str:
        """The case in a few words."""
        first = self.records[0]
        shape = f"{len(self.records)} records, {first.u.shape[1]} in, {first.y.shape[1]} out"
        fits = "no model" if self.model is None else f"{len(self.model['dof'])} DOF"
        loop = f", loop {self.loop}" if self.loop else ""
        return f"{self.seed}: {self.excitation}, {self.fault}{loop}; {shape}, {fits}"

    def write(self, folder: Path) -> list[tuple[Path, Path]]:
        """Write all files; return each record's table and signals file."""
        files = []
        for k, (record, signals) in enumerate(zip(self.records, self.signals, strict=True)):
            table, description = folder / f"r{k}.csv", folder / f"r{k}.yaml"
            np.savetxt(table, np.hstack([record.u, record.y]), delimiter=",", fmt="%.9g")
            description.write_text(yaml.safe_dump(dict(signals)))
            files.append((table, description))
        if self.model is not None:
            (folder / "model.yaml").write_text(yaml.safe_dump(dict(self.model)))
        return files


@dataclass(frozen=True)
class _Plant:
    """M q'' + D q' + K q = B u, noise (n,) of the readings and of the force."""

    M: Array
    D: Array
    K: Array
    B: Array
    sensor: float
    force: float

    def record(
        self, u: Array, rate_hz: float, rng: Generator, kp: Array | None = None
    ) -> DataRecord:
        """Return the motion for inputs u, with -kp (p, n) times the outputs added in a loop."""
        n, p = self.B.shape
        inverse, none, one = np.linalg.inv(self.M), np.zeros((n, n)), np.eye(n)
        A = np.block([[none, one], [-inverse @ self.K, -inverse @ self.D]])
        whole = np.zeros((2 * n + p, 2 * n + p))
        whole[: 2 * n, : 2 * n] = A
        whole[n : 2 * n, 2 * n :] = inverse @ self.B
        step = expm(whole / rate_hz)
        Ad, Bd = step[: 2 * n, : 2 * n], step[: 2 * n, 2 * n :]
        x, y, u = np.zeros(2 * n), np.zeros((len(u), n)), u.copy()
        for k in range(len(u)):
            y[k] = x[:n] + self.sensor * rng.normal(size=n)
            if kp is not None:
                u[k] -= kp @ y[k]
            x = Ad @ x + Bd @ (u[k] + self.force * rng.normal(size=p))
        return DataRecord(u, y, rate_hz)


def draw(seed: int) -> Case:
    """Return the data set of a seed."""
    rng = np.random.default_rng(seed)
    p, n = (int(rng.choice([1, 1, 1, 1, 2, 2, 3, 4])) for _ in range(2))
    plant = _chain(n, p, rng)
    loop = str(rng.choice(["", "", "", "declared", "undeclared", "unknown"]))
    excitation = str(rng.choice(list(_EXCITATIONS)))
    if loop and rng.random() < 0.5:
        excitation = str(rng.choice(["weak noise", "none"]))
    fault = str(rng.choice(["right", *_FAULTS]))
    rows, rate_hz = int(rng.choice([60, 250, 400, 800])), float(rng.choice([20.0, 50.0]))
    kp = np.zeros((p, n))
    kp[range(min(p, n)), range(min(p, n))] = 0.5 * plant.K[0, 0] if loop else 0.0
    records = []
    for k in range(int(rng.choice([1, 1, 1, 2, 3, 5]))):
        length = rows if k == 0 or rng.random() < 0.7 else max(2, int(rows * rng.random()))
        rate = rate_hz if k == 0 or rng.random() < 0.9 else 2.0 * rate_hz
        u = _EXCITATIONS[excitation](length, p, rng)
        records.append(plant.record(u, rate, rng, kp if loop else None))
    cannot = "no excitation" if excitation == "none" else ""
    if fault in _FAULTS:
        change, reason = _FAULTS[fault]
        records = [change(record, rng) for record in records]
        cannot = reason or cannot
    model = _model(plant, rng)
    unit = rng.random() < 0.2, int(rng.integers(0, p + n)), int(rng.integers(0, 3))
    signals = [_signals(r, loop, *unit) for r in records]
    return Case(seed, excitation, fault, loop, cannot, tuple(records), tuple(signals), model)


def _chain(n: int, p: int, rng: Generator) -> _Plant:
    """Return masses in a row, each on a spring and damper to its neighbour."""
    k, m = 50.0 * rng.uniform(0.5, 2.0, n + 1), rng.uniform(0.5, 2.0, n)
    d = 2.0 * 10.0 ** rng.uniform(-1.0, 0.0) * np.ones(n + 1)
    B = np.zeros((n, p))
    B[rng.integers(0, n, p), range(p)] = 1.0
    B[range(min(n, p)), range(min(n, p))] = 1.0
    sensor, force = 10.0 ** rng.uniform(-6.0, -3.0), float(rng.choice([0.0, 0.05, 0.3]))
    return _Plant(np.diag(m), _coupled(d), _coupled(k), B, sensor, force)


def _coupled(k: Array) -> Array:
    n = len(k) - 1
    return np.diag(k[:n] + k[1:]) - np.diag(k[1:n], 1) - np.diag(k[1:n], -1)


def _only_one(u: Array) -> Array:
    u[:, 1:] = 0.0
    return u


def _pulse(rows: int, p: int, _: Generator) -> Array:
    u = np.zeros((rows, p))
    u[rows // 3 : rows // 3 + 10] = 1.0
    return u


_EXCITATIONS: dict[str, Callable[[int, int, Generator], Array]] = {
    "noise": lambda rows, p, rng: rng.normal(size=(rows, p)),
    "slow noise": lambda rows, p, rng: 0.3 * np.cumsum(rng.normal(size=(rows, p)), axis=0),
    "weak noise": lambda rows, p, rng: 0.01 * rng.normal(size=(rows, p)),
    "steps": lambda rows, p, rng: np.repeat(rng.choice([-1.0, 1.0], (-(-rows // 25), p)), 25, 0)[
        :rows
    ],
    "integer steps": lambda rows, p, rng: np.round(3.0 * rng.normal(size=(rows, p))),
    "a sine": lambda rows, p, _: np.sin(np.outer(np.arange(rows), 0.1 + 0.07 * np.arange(p))),
    "one short step": _pulse,
    "one input moves": lambda rows, p, rng: _only_one(rng.normal(size=(rows, p))),
    "none": lambda rows, p, _: np.zeros((rows, p)),
}
Fault = Callable[[DataRecord, Generator], DataRecord]


def _each(change: Callable[[Array], Array]) -> Fault:
    return lambda r, _: replace(r, u=change(r.u), y=change(r.y))


def _with(change: Callable[[Array, Array, Generator], tuple[Array, Array]]) -> Fault:
    def changed(r: DataRecord, rng: Generator) -> DataRecord:
        u, y = change(r.u.copy(), r.y.copy(), rng)
        return replace(r, u=u, y=y)

    return changed


def _unstable(u: Array, y: Array, rng: Generator) -> tuple[Array, Array]:
    growth = np.exp(np.arange(len(y)) * rng.choice([0.005, 0.05, 0.5]))
    with np.errstate(over="ignore"):
        return u, np.minimum(y * growth[:, None], 1e300)


def _nan_blocks(u: Array, y: Array, rng: Generator) -> tuple[Array, Array]:
    for _ in range(3):
        at = int(rng.integers(0, len(y)))
        y[at : at + int(rng.integers(1, 40)), int(rng.integers(0, y.shape[1]))] = np.nan
    return u, y


def _nan_but_two(u: Array, y: Array, rng: Generator) -> tuple[Array, Array]:
    kept = rng.integers(0, len(y), 2)
    y[~np.isin(np.arange(len(y)), kept)] = np.nan
    return u, y


def _spike(u: Array, y: Array, rng: Generator) -> tuple[Array, Array]:
    y[int(rng.integers(0, len(y))), 0] = rng.choice([9.9e37, -9999.0, 50.0 * np.ptp(y[:, 0])])
    return u, y


def _twins(a: Array) -> Array:
    a[:, -1] = a[:, 0]
    return a


def _sum(a: Array) -> Array:
    a[:, -1] = a[:, :-1].sum(axis=1) if a.shape[1] > 1 else a[:, 0]
    return a


_FAULTS: dict[str, tuple[Fault, str]] = {
    "constant": (_each(np.ones_like), "constant"),
    "silent": (_each(np.zeros_like), "silent"),
    "dead outputs": (_with(lambda u, y, _: (u, 0.0 * y + 0.25)), "constant outputs"),
    "one dead output": (_with(lambda u, y, _: (u, y * (np.arange(y.shape[1]) > 0))), ""),
    "only one moves": (_with(lambda u, y, _: (u, y * (np.arange(y.shape[1]) == 0))), ""),
    "short": (_each(lambda a: a[:12]), "too short"),
    "one row": (_each(lambda a: a[:1]), "too short"),
    "nan but two": (_with(_nan_but_two), "too short"),
    "nan blocks": (_with(_nan_blocks), ""),
    "unstable": (_with(_unstable), ""),
    "huge": (_each(lambda a: 1e30 * a), ""),
    "beyond numbers": (_each(lambda a: 1e300 * a), ""),
    "tiny": (_each(lambda a: 1e-30 * a), ""),
    "coarse steps": (_with(lambda u, y, _: (u, np.round(2.0 * y / y.std()))), ""),
    "large level": (_each(lambda a: a + 1e6), ""),
    "twin outputs": (_with(lambda u, y, _: (u, _twins(y))), ""),
    "twin inputs": (_with(lambda u, y, _: (_twins(u), y)), ""),
    "output a sum": (_with(lambda u, y, _: (u, _sum(y))), ""),
    "input a sum": (_with(lambda u, y, _: (_sum(u), y)), ""),
    "output = input": (
        _with(lambda u, y, _: (u, u[:, np.arange(y.shape[1]) % u.shape[1]])),
        "identical",
    ),
    "exact gain": (_with(lambda u, y, _: (u, 3.0 * u[:, np.arange(y.shape[1]) % u.shape[1]])), ""),
    "noise alone": (_with(lambda u, y, rng: (u, rng.normal(size=y.shape))), "noise alone"),
    "spike": (_with(_spike), ""),
    "clipped": (_each(lambda a: np.clip(a, -0.5 * a.std(), 0.5 * a.std())), ""),
    "output dies": (_with(lambda u, y, _: (u, y * (np.arange(len(y)) < 40)[:, None])), ""),
    "not causal": (_with(lambda u, y, _: (u, np.roll(y, -5, axis=0))), ""),
    "columns swapped": (lambda r, _: replace(r, u=r.y, y=r.u), ""),
}
"""What is done to the data, and why no model can be had of them then."""


def _model(plant: _Plant, rng: Generator) -> dict[str, Any] | None:
    """Return a model of the plant, of other DOF, or none; its parameters are off by up to 30 %."""
    n, p = plant.B.shape
    kind = rng.choice([*["right"] * 8, "fewer", "more", "names", "none"])
    if kind == "none":
        return None
    n += {"fewer": -1, "more": 1}.get(str(kind), 0)
    n = max(n, 1)
    B = np.zeros((n, p))
    B[: min(n, len(plant.B))] = plant.B[:n]
    parameters, unit = {}, {"m": "kg", "d": "N s/m", "k": "N/m"}
    for name, start in (("m", 1.0), ("d", 1.0), ("k", 70.0)):
        for i in range(n + (name != "m")):
            value = float(start * rng.uniform(0.7, 1.3))
            parameters[f"{name}{i}"] = {"value": value, "unit": unit[name], **_BOUNDS}

    def entry(name: str, i: int, j: int) -> str | int:
        if abs(i - j) > 1 or (name == "m" and i != j):
            return 0
        if name == "m":
            return f"m{i}"
        return f"{name}{i} + {name}{i + 1}" if i == j else f"-{name}{max(i, j)}"

    prefix = "other" if kind == "names" else "x"
    return {
        "levid": "model",
        "name": "chain",
        "dof": [{"name": f"{prefix}{i}_m", "unit": "m"} for i in range(n)],
        "inputs": [{"name": f"f{j}_n", "unit": "N"} for j in range(p)],
        "parameters": parameters,
        **{
            name.upper(): [[entry(name, i, j) for j in range(n)] for i in range(n)]
            for name in "mdk"
        },
        "B": B.tolist(),
    }


def _signals(
    record: DataRecord, loop: str, other_unit: bool, column: int, which: int
) -> dict[str, Any]:
    """Return the SIGNALS.yaml of a record, with another unit for one column if asked."""
    names = [(f"f{j}_n", "N", "input") for j in range(record.u.shape[1])]
    names += [(f"x{i}_m", "m", "output") for i in range(record.y.shape[1])]
    columns: list[dict[str, Any]] = [
        {"column": k, "name": name, "unit": unit, "role": role}
        for k, (name, unit, role) in enumerate(names)
    ]
    if other_unit:
        columns[column]["unit"] = _UNITS[columns[column]["unit"]][which]
    found: dict[str, Any] = {
        "levid": "signals",
        "rate_hz": record.rate_hz,
        "columns": columns,
    }
    if loop == "unknown":
        found["loop"] = {"controller": "unknown"}
    elif loop == "declared":
        laws = {
            f"f{j}_n": {"loops": [{"measured": f"x{j}_m", "reference": 0.0, "kp": 25.0}]}
            for j in range(min(record.u.shape[1], record.y.shape[1]))
        }
        found["loop"] = {"controller": {"pid": laws}}
    return found
