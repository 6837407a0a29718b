"""Compute one control cycle: control law, limits, states, faults, coil check, self-test."""
