"""The error of commissioning."""


class CommissionError(Exception):
    """Report that a step of commissioning cannot be done, and what to do about it."""
