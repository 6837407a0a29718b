"""`levid watch`: show the daemon's state on the full screen, or line by line."""
