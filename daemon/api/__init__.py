"""Answer clients on the control socket; serve Prometheus metrics."""
