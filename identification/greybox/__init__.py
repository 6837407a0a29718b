"""The declared model fitted to records: prediction, noise, Gauss-Newton, what cannot be told apart."""
