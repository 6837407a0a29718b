"""The declared model: geometry and LPV equations as pure functions, no files, no devices."""
