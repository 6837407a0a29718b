"""Write the report on a trace."""
