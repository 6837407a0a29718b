"""Serial protocol: framing, frames, time on the line."""
