"""Page of a commissioning: what was found of every channel."""
