"""Inspection of a recording before any physics."""
