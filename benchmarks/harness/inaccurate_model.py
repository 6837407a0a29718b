"""A declared model that is off, as what somebody measured with a ruler and scales is."""

from __future__ import annotations

import numpy as np

from levid.config.model import ModelConfig, load_model
from levid.config.shipped import shipped


def off_by_a_tenth(seed: int) -> ModelConfig:
    """Return the rig's model with every free parameter 10 % off, at random."""
    config, rng = load_model(shipped("models/rig.yaml")), np.random.default_rng(seed)
    parameters = {}
    for name, p in config.parameters.items():
        value = p.value * (1 + 0.1 * rng.standard_normal()) if p.value else 2e-5
        parameters[name] = p if p.is_fixed else p.model_copy(update={"value": float(value)})
    return config.model_copy(update={"parameters": parameters})
