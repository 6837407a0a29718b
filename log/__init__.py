"""The log: one record a cycle in MCAP, its writer, its reader, and the import of others' data."""
