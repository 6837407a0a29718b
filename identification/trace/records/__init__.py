"""Read the records of a trace and the noise, loads and signals in them."""
