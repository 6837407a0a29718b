"""Write rows, faults and coil heat to disk, and hand finished logs to identification."""
