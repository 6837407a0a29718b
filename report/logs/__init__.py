"""Figures of single logs."""
