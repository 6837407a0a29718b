"""Serve the live view, a Foxglove stream and a page, from a process that can only read."""
