"""Load, identify, trace and fly from Python; the commands call the same functions."""
