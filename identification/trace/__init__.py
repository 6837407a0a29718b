"""Trace the residual of a model to physical effects."""
