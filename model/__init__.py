"""Geometry, declared LPV model and physical effects as pure functions without I/O."""
