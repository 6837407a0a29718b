"""Compute a model's residual: force residual, free-run errors, random vibration."""
