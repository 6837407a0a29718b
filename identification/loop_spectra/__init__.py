"""Spectra of records in a known loop: lines, measured response and noise, fit of a plant."""
