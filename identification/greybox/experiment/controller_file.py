"""Convert a controller's configuration to its matrices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ....config.controller import ControllerConfig
from ....model.controller import Controller
from ....model.pid_and_state_space_controllers import (
    PidLaw,
    PidLoop,
    StateSpaceLaw,
    delayed,
    pid_controller,
    state_space_controller,
)


def controller_of_config(
    config: ControllerConfig, inputs: Sequence[str], outputs: Sequence[str], Ts_s: float
) -> tuple[Controller, tuple[str | float | None, ...]]:
    """Return the controller, and its references: columns, constants, or None if not stated.

    `inputs` and `outputs` are the plant's, in the order of u and y. Raises ValueError if the
    configuration names others.
    """
    sources: tuple[str | float | None, ...]
    if config.state_space is not None:
        law = _state_space(config)
        made = state_space_controller(law, inputs, outputs, Ts_s)
        sources = tuple(law.references(outputs))
    else:
        laws = {name: _pid(config, name) for name in config.pid}
        made = pid_controller(laws, inputs, outputs, Ts_s)
        sources = tuple(law.loops[0].reference for law in config.pid.values())
    for _ in range(config.delay_rows):
        made = delayed(made)
    return made, sources


def _pid(config: ControllerConfig, name: str) -> PidLaw:
    law = config.pid[name]
    loops = tuple(
        PidLoop(q.measured, q.gains, q.rate, q.average, q.derivative_filter_s, q.derivative_of)
        for q in law.loops
    )
    limits = law.limits or (-np.inf, np.inf)
    return PidLaw(loops, limits, law.tracking_s, law.actuator_gain, law.actuator_lag_s)


def _state_space(config: ControllerConfig) -> StateSpaceLaw:
    law = config.state_space
    assert law is not None
    n, p, m = len(law.A), len(law.drives), len(law.w)
    shapes = {"A": (n, n), "B": (n, m), "C": (p, n), "D": (p, m)}
    A, B, C, D = (np.array(getattr(law, key), float).reshape(s) for key, s in shapes.items())
    limits = None if law.limits is None else np.array(law.limits, float).T
    return StateSpaceLaw(law.drives, law.w, A, B, C, D, limits)
