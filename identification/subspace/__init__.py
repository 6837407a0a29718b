"""Estimate state-space models by Ho-Kalman and predictor-based subspace identification."""
