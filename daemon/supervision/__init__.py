"""Start and monitor the daemon's processes; execute client requests."""
