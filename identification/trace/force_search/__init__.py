"""Search for the effects that held-out blocks of the force balance confirm."""
