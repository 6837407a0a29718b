"""Find the physical effects that a model lacks."""
