"""Swappable backends for the three roles: coil amplifiers, position sensors, manipulator drives."""
