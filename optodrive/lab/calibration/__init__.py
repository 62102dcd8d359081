"""Calibration: measured spots to a scan field with its uncertainty, measured heights to a pixel map."""
