"""Linearise prediction errors in parameters and candidate effects."""
