"""Amplifiers and ADC by a DBC file, drives as CANopen nodes, on any bus that python-can knows."""
