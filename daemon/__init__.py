"""Fly the platform: a timed loop, its recorder, planner and control socket, supervised."""
