"""Figures and the report page: plain arrays in, one HTML file that opens from disk out."""
