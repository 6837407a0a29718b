"""Measure what a model leaves unexplained: force residual, free-run errors, random vibration."""
