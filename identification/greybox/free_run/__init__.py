"""Simulation without measured outputs, and the error that noise alone leaves of it."""
