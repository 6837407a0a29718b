"""Draw figures and write report pages as single HTML files."""
