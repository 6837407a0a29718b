"""Run as a systemd service: unit files, notifications, journal."""
