"""Identification: log -> records -> Markov parameters and frequency response -> plant."""
