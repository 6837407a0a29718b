"""Fit the declared model to records by maximum likelihood, with its noise floor."""
