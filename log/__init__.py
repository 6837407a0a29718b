"""Write and read logs (MCAP, one record per cycle), and import other measured data."""
