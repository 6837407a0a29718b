"""Draw and write: style, panel grids, SVG, the HTML page."""
