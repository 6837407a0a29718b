"""Catalogue of flights and results below a folder."""
