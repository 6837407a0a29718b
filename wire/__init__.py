"""Encode and decode frames, with checksums and time on the bus."""
