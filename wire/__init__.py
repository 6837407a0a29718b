"""What is on the wire: layouts, checksums and times of frames; pure functions, no I/O."""
