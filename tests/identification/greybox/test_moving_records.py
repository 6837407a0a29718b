"""Test what records with a moving beam add to records at rest, on flights of the nominal rig."""

from __future__ import annotations

import numpy as np
import pytest

from levid.benchmarks.harness.inaccurate_model import off_by_a_tenth
from levid.benchmarks.identification.greybox_accuracy import flown
from levid.config.model import ModelConfig, load_model
from levid.config.shipped import shipped
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.fit import Fit
from levid.identification.greybox.fit_in_loop import fit_in_loop

SURE = 4.0


@pytest.fixture(scope="module")
def start() -> ModelConfig:
    return off_by_a_tenth(3)


@pytest.fixture(scope="module")
def experiments(start: ModelConfig) -> list[Experiment]:
    return flown(start, 8.0, 8.0, 3)


@pytest.fixture(scope="module")
def with_motion(start: ModelConfig, experiments: list[Experiment]) -> Fit:
    return fit_in_loop(start, experiments, (), None)[0]


def test_a_moving_beam_determines_its_height(with_motion: Fit) -> None:
    truth = load_model(shipped("models/rig.yaml"))
    assert with_motion.unidentifiable == ()
    assert with_motion.standard_errors["z_b"] < 0.01 * truth.parameters["z_b"].value
    for name, se in with_motion.standard_errors.items():
        error = with_motion.values[name] - truth.parameters[name].value
        assert abs(error) < SURE * se, name


def test_what_depends_on_the_height_is_known_as_well(
    start: ModelConfig, experiments: list[Experiment], with_motion: Fit
) -> None:
    at_rest, _ = fit_in_loop(start, [e for e in experiments if not e.moving], (), None)
    assert [u.name for u in at_rest.unidentifiable] == ["z_b"]
    for name in ("J_psi", "J_theta"):
        assert with_motion.standard_errors[name] < 0.1 * at_rest.standard_errors[name]
    # Either way the records know J + m_b z_b^2, as accurately.
    for fit in (at_rest, with_motion):
        v = fit.values
        assert v["J_psi"] + v["m_b"] * v["z_b"] ** 2 == pytest.approx(
            0.062 + 1.4 * 0.06**2, rel=2e-3
        )


def test_covariance_is_one_of_random_variables(with_motion: Fit) -> None:
    sd = np.sqrt(np.diag(with_motion.covariance))
    assert np.min(np.linalg.eigvalsh(with_motion.covariance / np.outer(sd, sd))) > 0.0
