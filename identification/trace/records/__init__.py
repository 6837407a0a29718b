"""Read the records of a trace, and estimate their noise, loads and signals."""
