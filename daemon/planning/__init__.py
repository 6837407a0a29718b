"""Plan a session or command as segments before the flight, in a separate process."""
