"""Control, excite, log and identify a magnetically levitated platform."""

__version__ = "0.1.0"
