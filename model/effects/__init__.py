"""Equations of physical effects that a declared model may lack; one file per kind of effect."""
