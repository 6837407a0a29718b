"""Encode and decode CAN and serial frames, with checksums and their time on the bus."""
