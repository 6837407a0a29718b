"""Schemas of the YAML files, and the files that levid ships."""
