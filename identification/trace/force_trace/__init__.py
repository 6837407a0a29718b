"""Trace the missing force of imported records to effects, and summarise the result."""
