"""The declared model with further modes, fitted to the spectra of records in a known loop."""
