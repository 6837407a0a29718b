"""Compare two fits of one plant: how often does `levid compare` call them different?

A mass on a spring with a damper, 100 Hz, 20 s of white force, with white force noise and
measurement noise. Each pair of seeds draws two records and fits both; the plant is the same, so
every difference is chance. Nominal: 5 % of single tests at 1.96 standard errors, at most 5 % of
pairs with any parameter called different (Holm), 5 % of pairs by the test of all parameters (Wald),
at most 5 % of pairs by the response (Scheffe). Then the stiffness of one plant is changed by a
number of standard errors: how often is it found?
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.signal import lfilter, ss2tf

from levid.benchmarks.harness.benchmark_runner import Figure, Target, run
from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.comparison.compare_results import Comparison, compare
from levid.identification.comparison.saved_result import SavedResult
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.fit import fit_model
from levid.identification.greybox.identify_greybox import fitted_model
from levid.model.second_order import discretise

MASS = parse_text(
    """
levid: model
name: mass
dof: [{name: x, unit: m}]
inputs: [{name: f, unit: N}]
parameters:
  m: {value: 2.0, unit: kg, min: 0.1, max: 20}
  d: {value: 6.0, unit: N s/m, min: 0, max: 100}
  k: {value: 800.0, unit: N/m, min: 1, max: 10000}
M: [[m]]
D: [[d]]
K: [[k]]
""",
    ModelConfig,
    "mass",
)
Ts_S, ROWS = 0.01, 2000
FORCE_NOISE, NOISE = 0.05, 0.01
"""Of the force and of the output's standard deviation."""
PAIRS, QUICK = 400, 20
CHANGE = 6.0
"""Change of the stiffness in standard errors of the difference."""


def fitted(seed: int, k_n_m: float = 800.0) -> SavedResult:
    """Return the fit of one record of a plant with this stiffness."""
    rng = np.random.default_rng(seed)
    plant = discretise(declared_model(MASS).with_values({"k": k_n_m}).at(), Ts_S)
    num, den = ss2tf(plant.A, plant.B, plant.C, plant.D)
    u = rng.normal(size=ROWS)
    y = lfilter(num[0], den, u + FORCE_NOISE * rng.normal(size=ROWS))
    y += NOISE * y.std() * rng.normal(size=ROWS)
    record = Experiment(
        f"seed-{seed}", Ts_S, u[:, None], y[:, None], {}, frozenset(), moving=False, hold="zoh"
    )
    fit = fit_model(MASS, [record])
    name = Path(f"seed-{seed}")
    return SavedResult(name, fitted_model(MASS, fit), fit.free, fit.covariance, correlated=True)


def measure(quick: bool) -> Iterator[Figure]:
    """Yield the shares of pairs, and of single tests, that are called different."""
    pairs = QUICK if quick else PAIRS
    results = [fitted(seed) for seed in range(2 * pairs)]
    equal = [compare(a, b) for a, b in zip(results[::2], results[1::2], strict=True)]
    yield Figure("pairs", pairs, "", "pairs of fits of one plant")
    z = np.array([[d.in_errors for d in found.parameters] for found in equal], float)
    single = 100.0 * float(np.mean(np.abs(z) > 1.96))
    # 20 pairs decide nothing.
    near = None if quick else Target(least=3.0, most=7.0)
    most = None if quick else Target(most=7.0)
    yield Figure("single", single, "%", "single tests beyond 1.96 standard errors", None, near)
    yield Figure("spread", float(z.std()), "", "standard deviation of differences in their errors")
    any_one = _share([bool(found.significant) for found in equal])
    yield Figure("any", any_one, "%", "pairs with any parameter (Holm)", None, most)
    whole = _share([found.whole is not None and found.whole[2] < 0.05 for found in equal])
    yield Figure("whole", whole, "%", "pairs by all parameters (Wald)", None, near)
    response = _share([_response_differs(found) for found in equal])
    yield Figure("response", response, "%", "pairs by the response (Scheffe)", None, most)
    # The same records with another stiffness.
    error = float(np.mean([d.se for found in equal for d in found.parameters if d.name == "k"]))
    moved = [fitted(seed, 800.0 + CHANGE * error) for seed in range(1, 2 * pairs, 2)]
    changed = [compare(a, b) for a, b in zip(results[::2], moved, strict=True)]
    names = [{d.name for d in found.significant} for found in changed]
    yield Figure(
        "found", _share(["k" in n for n in names]), "%", f"stiffness changed by {CHANGE:g}: found"
    )
    others = _share([bool(n - {"k"}) for n in names])
    yield Figure("others", others, "%", "... and another parameter", None, most)


def _response_differs(found: Comparison) -> bool:
    return found.response is not None and any(p.p_value < 0.05 for p in found.response.paths)


def _share(values: list[bool]) -> float:
    return 100.0 * float(np.mean(values))


if __name__ == "__main__":
    run("Significance of comparisons", measure)
