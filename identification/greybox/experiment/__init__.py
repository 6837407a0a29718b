"""Records of a plant for the fit: signals, schedule, controller, and the input between samples."""
