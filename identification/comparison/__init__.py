"""Compare two identified models: parameters, frequency responses, effects."""
