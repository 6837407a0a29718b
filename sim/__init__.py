"""Simulated rig: plant, imperfections and effects, and its true frequency response."""
