"""From what a model leaves unexplained to the physical effect behind it."""
