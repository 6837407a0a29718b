"""Share memory and messages between the daemon's processes."""
