"""Import tables of measured data (CSV, text, NPZ, MAT): columns, units, time, gaps, and the log."""
