"""Run as a systemd service: its files, its notifications, its journal."""
