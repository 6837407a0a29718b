"""Fit of the declared model and of further modes to the spectra of records in a known loop."""
