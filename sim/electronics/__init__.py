"""Electronics that answer on a bus: amplifiers, ADC and drives with the simulated plant behind."""
