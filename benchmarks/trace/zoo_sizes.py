"""How large each effect of the zoo has to be: sized by flying it, kept in zoo-sizes.yaml.

The size that counts is what the effect leaves of error, not what it does: the declared model is
refitted to a flight with the effect, and its free-running error on held-out records is compared
with the noise floor of a plant that holds nothing: an effect that never rests is noise to whoever
does not know it, and would raise its own floor. Noise and effect add up in squares, so what an
effect of the scale s adds is sqrt(ratio^2 - 1), and between two flights that is taken to go with a
power of s.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from levid.benchmarks.trace.zoo_cases import ZooCase
from levid.benchmarks.trace.zoo_fly import (  # fmt: skip
    MODEL,
    SESSION,
    SIM,
    TooLargeError,
    canonical,
    fly_and_refit,
    rig_plain,
)
from levid.benchmarks.trace.zoo_pool import run_apart
from levid.config.base import read_mapping

SIZES = Path(__file__).with_name("zoo-sizes.yaml")
TARGETS = (5.0, 20.0)
"""Error of the declared model, refitted, over the noise floor."""
SEED = 1

_HEAD = (
    "# Sizes of the zoo's effects, flown by benchmarks/trace/zoo.py, which flies what is missing"
    "\n# here or sized for another case, session or plant (`of`). flown: [scale, error/floor].\n"
)
_NOTHING = "nothing"
_LONGEST_S = 5400.0
_MOST_FLIGHTS = 6
_NEAR = 1.4
"""An error within this factor of one that was flown is known well enough."""
_NARROW = 1.03
"""Scales that are closer are one."""
_FARTHEST = 16.0
_FAINT = 0.3
"""What adds less than this is lost in the spread of the floor."""
_ABSORBED = 4.0
"""Where no error tells the size, the larger of the two is this many times the nominal one."""
_BOUNDS: dict[str, tuple[float, float]] = {
    "excess": (0.0, 1.0),  # no coil, no sensor, no Coriolis' force at all; or twice as much
    "loss": (0.0, 0.5),
    "share": (0.0, 0.5),
    "d_n_s_m": (0.0, 4.0),  # as much as is declared; beyond, all that moves the film is damped
    "distance_m": (2e-3, math.inf),
    "limit_n": (10.0, math.inf),  # each coil carries 8 N
    "width_n": (0.0, 8.0),
    "stuck_s": (0.0, 1.0),
    "lag_s": (0.0, 5e-3),
    "delay_s": (0.0, 5e-3),
}
"""Between which magnitudes a value makes sense."""


@dataclass(frozen=True)
class Sizes:
    """Scales of a case that make its error 5 and 20 times the floor, or as large as can be.

    flown: (scale, error over floor) of the flights that tell. `limited` says what allows no more.
    """

    of: str
    at: dict[float, float]
    flown: tuple[tuple[float, float], ...] = ()
    limited: str = ""

    def scale(self, times: float) -> float:
        """Return the scale for an error of `times` the floor, one of TARGETS or between them."""
        if times in self.at:
            return self.at[times]
        if not self.flown:
            return min(self.at.values())
        return min(_interpolated(self.flown, times), max(self.at.values()))


def sizes_of(
    cases: Sequence[ZooCase], processes: int, say: Callable[[str], None]
) -> dict[str, Sizes]:
    """Return the sizes of cases: those of the file, and the rest flown now and put there.

    A case that cannot be sized keeps its nominal size, and is tried again the next time.
    """
    sizes = _read()
    missing = {
        case.name: case
        for case in cases
        if case.name not in sizes or sizes[case.name].of != _fingerprint(case)
    }
    if missing:
        say(f"flying {len(missing)} cases for their sizes")
        sized = partial(_sized, floor_m=noise_floor_m(say))
    for done in run_apart(sized, missing.values(), processes, _LONGEST_S) if missing else ():
        if done.answer is None:
            # It is flown as it is all the same, so that it does not drop out of the count.
            sizes[done.item.name] = _as_it_is(done.item, done.failed)
            say(f"size of {done.item.name}: {done.failed}")
            continue
        sizes[done.item.name] = done.answer
        _write({name: s for name, s in sizes.items() if s.flown or not s.limited})
        flown = ", ".join(f"{ratio:.3g} at {scale:.3g}" for scale, ratio in done.answer.flown)
        say(f"size of {done.item.name}: {flown or 'absorbed'} {done.answer.limited}".rstrip())
    return sizes


def known_sizes() -> dict[str, Sizes]:
    """Return the sizes in the file, whatever they were flown for."""
    return _read()


def known_floor_m() -> float | None:
    """Return what `noise_floor_m` does, if that is in the file; None if it has to be flown."""
    row = _rows().get(_NOTHING)
    return None if row is None or row["of"] != _fingerprint(None) else float(row["floor_m"])


def noise_floor_m(say: Callable[[str], None]) -> float:
    """Return what noise leaves of error in a plant that holds nothing, m rms over rows and sensors.

    It is in the file of sizes, or flown now and put there.
    """
    known = known_floor_m()
    if known is not None:
        return known
    say("flying a plant that holds nothing, for its noise floor")
    (done,) = run_apart(_floor, [SEED], 1, _LONGEST_S)
    if done.answer is None:
        raise SystemExit(f"error: the plant that holds nothing cannot be flown: {done.failed}")
    floor_m = _short(done.answer)
    _write_rows(_rows() | {_NOTHING: {"of": _fingerprint(None), "floor_m": floor_m}})
    return floor_m


def _floor(seed: int) -> float:
    return fly_and_refit((), seed)[1]


def _sized(case: ZooCase, floor_m: float) -> Sizes:
    """Return the sizes of a case, flown where the model does not absorb it.

    Raises TooLargeError if not even the nominal size can be flown.
    """
    if case.absorbed is not None or not case.sized:
        return _as_it_is(case, "")
    return _Search(case, lambda effects, seed: fly_and_refit(effects, seed)[0] / floor_m).run()


def _as_it_is(case: ZooCase, limited: str) -> Sizes:
    scales = dict(zip(TARGETS, (1.0, _ABSORBED), strict=True))
    return Sizes(_fingerprint(case), scales, (), limited)


def _fingerprint(case: ZooCase | None) -> str:
    """Return a digest of all that the sizes of a case, or of a plant without one, depend on."""
    what: list[Any] = []
    if case is not None:
        use = case.use.rpartition("/")[2]  # wherever the benchmarks lie
        what = [use, dict(case.values), dict(case.size), case.absorbed, case.sized]
    text = canonical([what, *map(read_mapping, (SESSION, SIM, MODEL)), rig_plain()])
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _read() -> dict[str, Sizes]:
    """Return what is known of all cases, by name."""
    return {
        name: Sizes(
            row["of"],
            {times: float(row[_key(times)]) for times in TARGETS},
            tuple((float(scale), float(ratio)) for scale, ratio in row.get("flown", [])),
            row.get("limited", ""),
        )
        for name, row in _rows().items()
        if name != _NOTHING
    }


def _write(sizes: dict[str, Sizes]) -> None:
    """Keep sizes, all of them, for the next time."""
    rows = {name: row for name, row in _rows().items() if name == _NOTHING}
    for name, s in sizes.items():
        rows[name] = {"of": s.of, **{_key(t): v for t, v in s.at.items()}}
        if s.flown:
            rows[name]["flown"] = [list(point) for point in s.flown]
        if s.limited:
            rows[name]["limited"] = s.limited
    _write_rows(rows)


def _rows() -> dict[str, dict[str, Any]]:
    return (yaml.safe_load(SIZES.read_text(encoding="utf-8")) or {}) if SIZES.exists() else {}


def _write_rows(rows: dict[str, dict[str, Any]]) -> None:
    lines = [_HEAD]
    for name in sorted(rows):
        flow = yaml.safe_dump(rows[name], default_flow_style=True, sort_keys=False, width=math.inf)
        lines.append(f"{name}: {flow}")
    beside = SIZES.with_suffix(".part")
    beside.write_text("".join(lines), encoding="utf-8")
    beside.replace(SIZES)


@dataclass
class _Search:
    """Flights at a few scales, chosen as it goes."""

    case: ZooCase
    fly: Callable[[Sequence[dict[str, Any]], int], float]
    flown: dict[float, float] = field(default_factory=dict)

    def run(self) -> Sizes:
        bound = _largest(self.case)
        if bound is not None and bound[0] < 1.0:
            raise TooLargeError(f"{self.case.name}: at its nominal size, {bound[1]}")
        self._try(1.0)
        # The smallest of what was flown in vain.
        vain: tuple[float, str] | None = None
        for flight in range(1, _MOST_FLIGHTS):
            # In turns, the largest first: it tells the most.
            turn = TARGETS[::-1] if flight % 2 else TARGETS
            wanted = [self._wanted(t, bound, vain) for t in turn if not self._near(t)]
            far = next((scale for scale in wanted if self._is_new(scale)), None)
            if far is None:
                break
            try:
                self._try(far)
            except TooLargeError as error:
                vain = (far, str(error))
        most = bound if vain is None else (max(self.flown), vain[1])
        # As they are written, or a plant flown today would not be the one of the file tomorrow.
        at = {times: _short(self._at_most(times, most)) for times in TARGETS}
        free = {times: _short(self._at_most(times, None)) for times in TARGETS}
        return Sizes(
            _fingerprint(self.case),
            at,
            tuple((_short(scale), _short(ratio)) for scale, ratio in self._points),
            "" if most is None or at == free else most[1],
        )

    @property
    def _points(self) -> tuple[tuple[float, float], ...]:
        return tuple(sorted(self.flown.items()))

    def _try(self, scale: float) -> None:
        ratio = self.fly([self.case.effect(scale)], SEED)
        if math.isinf(ratio):
            raise TooLargeError("the refitted model runs away")
        self.flown[scale] = ratio

    def _near(self, times: float) -> bool:
        return any(1 / _NEAR <= ratio / times <= _NEAR for ratio in self.flown.values())

    def _wanted(
        self, times: float, bound: tuple[float, str] | None, vain: tuple[float, str] | None
    ) -> float:
        """Return the scale to fly next for an error of `times` the floor."""
        scale = min(self._at_most(times, bound), _FARTHEST * max(self.flown))
        if vain is not None and scale > max(self.flown):
            # Halfway from what flies to what does not.
            scale = min(scale, math.sqrt(vain[0] * max(self.flown)))
        return scale

    def _at_most(self, times: float, most: tuple[float, str] | None) -> float:
        return min(_interpolated(self._points, times), math.inf if most is None else most[0])

    def _is_new(self, scale: float) -> bool:
        return all(max(scale / s, s / scale) > _NARROW for s in self.flown)


def _largest(case: ZooCase) -> tuple[float, str] | None:
    """Return the largest scale at which all values make sense, and which one says so."""
    found = []
    for key, power in case.size.items():
        low, high = _BOUNDS.get(key, (0.0, math.inf))
        value = case.values[key]
        sizes = [abs(float(v)) for v in (value if isinstance(value, list) else [value]) if v]
        for size in sizes:
            bound = high if power > 0 else low
            if 0.0 < bound < math.inf:
                found.append(((bound / size) ** (1 / power), f"{key} {bound:g} at most"))
                if power < 0:
                    found[-1] = (found[-1][0], f"{key} {bound:g} at least")
    return min(found, default=None)


def _interpolated(points: Sequence[tuple[float, float]], times: float) -> float:
    """Return the scale at which the error is `times` the floor, on a power law between flights."""
    wanted = math.log(math.sqrt(times**2 - 1.0))
    known = [(math.log(scale), math.log(_added(ratio))) for scale, ratio in sorted(points)]
    loud = [(s, e) for s, e in known if e > math.log(_FAINT)] or known[-1:]
    slope = 1.0
    if len(loud) > 1:
        # The two flights around the target, or the two nearest to it.
        above = next((i for i, (_, e) in enumerate(loud) if e > wanted), len(loud) - 1)
        (s0, e0), (s1, e1) = loud[max(above, 1) - 1], loud[max(above, 1)]
        slope = min(max((e1 - e0) / max(s1 - s0, 1e-9), 0.3), 4.0)
    near = min(loud, key=lambda point: abs(point[1] - wanted))
    return math.exp(near[0] + (wanted - near[1]) / slope)


def _added(ratio: float) -> float:
    return math.sqrt(max(ratio**2 - 1.0, 1e-4))


def _key(times: float) -> str:
    return f"x{times:g}"


def _short(value: float) -> float:
    return float(f"{value:.4g}")
