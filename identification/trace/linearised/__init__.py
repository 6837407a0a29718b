"""Linearise a record's prediction errors in parameters and candidate effects."""
