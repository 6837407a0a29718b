"""Answer clients on the control socket and publish metrics."""
