"""Calibration of the scan field from measured spots and of the pixel map from measured heights."""
