"""Build the table of candidate effects that a model may lack."""

from __future__ import annotations

from . import (
    actuator_nonlinearity,
    backlash,
    base_magnets_attracting_beam,
    beam,
    beam_bearing_play,
    beam_bearing_presliding,
    beam_friction_and_cogging,
    characteristic_after_lag,
    coil_drift,
    coil_gain,
    coil_limits,
    coil_timing,
    damping,
    drifting_parameters,
    end_stop,
    flexible,
    friction,
    friction_along_position,
    friction_leveling_off,
    friction_of_load,
    gravity,
    input_crosstalk,
    linear_entries,
    load_behind_gap,
    load_on_shaft,
    magnetic_force,
    mass,
    motor_cogging,
    output_readings,
    permanent_magnet,
    power_laws,
    rate_limit,
    relative_motion_laws,
    rotating_arm_inertia,
    rotor,
    scale_and_arm_length,
    sensor_dynamic,
    sensor_static,
    stiffness,
    swinging_coupling,
    torque_ripple,
    vibration,
)
from .base import Effect, Places, resolved
from .operating_range import Extent


def all_effects(places: Places, extent: Extent | None = None) -> tuple[Effect, ...]:
    """Return every effect at every location of a plant, each with a unique identity.

    `extent` is the range of the records, which sets start values and bounds of nonlinear
    parameters; default: the rig's typical range.
    """
    covered = Extent.typical(places) if extent is None else extent
    found: list[Effect] = [
        *stiffness.effects(places, covered),
        *damping.effects(places, covered),
        *power_laws.effects(places, covered),
        *friction.effects(places, covered),
        *friction_leveling_off.effects(places, covered),
        *friction_along_position.effects(places, covered),
        *flexible.effects(places, covered),
        *mass.effects(places, covered),
        *beam.effects(places),
        *beam_friction_and_cogging.effects(places, covered),
        *beam_bearing_presliding.effects(places, covered),
        *beam_bearing_play.effects(places, covered),
        *base_magnets_attracting_beam.effects(places, covered),
        *rotor.effects(places),
        *coil_gain.effects(places),
        *coil_timing.effects(places, covered),
        *coil_limits.effects(places, covered),
        *rate_limit.effects(places, covered),
        *coil_drift.effects(places),
        *sensor_static.effects(places, covered),
        *sensor_dynamic.effects(places, covered),
        *scale_and_arm_length.effects(places),
        *gravity.effects(places),
        *swinging_coupling.effects(places),
        *rotating_arm_inertia.effects(places),
        *backlash.effects(places, covered),
        *end_stop.effects(places, covered),
        *load_behind_gap.effects(places, covered),
        *load_on_shaft.effects(places, covered),
        *drifting_parameters.effects(places, covered),
        *motor_cogging.effects(places, covered),
        *torque_ripple.effects(places, covered),
        *magnetic_force.effects(places, covered),
        *permanent_magnet.effects(places, covered),
        *actuator_nonlinearity.effects(places, covered),
        *friction_of_load.effects(places, covered),
        *characteristic_after_lag.effects(places, covered),
        *input_crosstalk.effects(places),
        *linear_entries.effects(places),
        *relative_motion_laws.effects(places, covered),
        *output_readings.effects(places, covered),
    ]
    found = resolved(found, covered.fastest_hz)
    for f_hz in covered.tones_hz:
        found += vibration.tone(places, f_hz)
    return tuple(found)
