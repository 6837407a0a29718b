"""Emulated electronics: amplifiers, ADC and drives of the simulated plant, on a bus."""
