"""Page that compares two results of identify or trace."""
