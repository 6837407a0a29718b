"""Serial backend: all roles on serial ports, in the protocol of docs/serial-protocol.md."""
