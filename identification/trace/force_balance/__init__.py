"""The balance of forces of a record: what acts, what moves, and what the model lacks."""
