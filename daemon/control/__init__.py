"""Compute one cycle: control law, limits, states, faults, checks of coils and readings."""
