"""The daemon: clock, loop, control, excitation, session, limits, recorder, server."""
