"""Start and watch the daemon's processes, and run what clients request."""
