"""CAN backend: amplifiers and ADC by a DBC file, drives as CANopen nodes (CiA 402)."""
