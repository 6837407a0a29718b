"""CAN: frames, buses, adapters, timestamps."""
