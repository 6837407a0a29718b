"""The serial protocol: framing and frames."""
