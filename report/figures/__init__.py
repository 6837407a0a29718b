"""Draw one figure of an identification; each file is one figure."""
