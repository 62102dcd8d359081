"""Drivers of laser DACs, and the bytes of their points."""
