"""Plotting style, panel grids, SVG output and the HTML page."""
