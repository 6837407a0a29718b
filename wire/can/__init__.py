"""CAN: frames, buses, adapters, timestamps, time on the bus."""
