"""Estimate state-space models: Ho-Kalman and predictor-based subspace identification."""
