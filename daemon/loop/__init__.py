"""Run the control cycle at its rate, in real time or in virtual time."""
