"""Estimate Markov parameters and frequency responses."""
