"""Fit a model with effects to the force balance of records, block by block."""
