"""The declared model fitted to records: prediction, noise, Gauss-Newton, identifiability."""
