"""Measured data and the board: recordings, diagnosis, validation, calibration, commissioning."""
