"""Backends for coil amplifiers, position sensors and manipulator drives: loopback, CAN, serial."""
