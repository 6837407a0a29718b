"""Export logs as tables: CSV, Parquet, MAT and NPZ, chunk by chunk."""
