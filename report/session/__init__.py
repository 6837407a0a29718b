"""Write the report on a flown session."""
