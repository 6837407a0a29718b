"""Level of the tests of an identification's report and terminal answer; imports no matplotlib."""

SIGNIFICANT = 0.01
"""Overall p-value of all tests of one kind below which distortion is significant."""
