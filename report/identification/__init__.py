"""Write the sections of an identification report."""
