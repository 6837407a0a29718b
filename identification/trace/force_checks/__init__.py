"""Check the effects that a search found: certainty, intervals, and rival explanations."""
