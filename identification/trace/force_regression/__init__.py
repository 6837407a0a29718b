"""Trace imported records: regress the force that a model lacks on the forces of effects."""
