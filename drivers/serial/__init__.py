"""Amplifiers, sensors and drives on serial ports, in the protocol of docs/serial-protocol.md."""
