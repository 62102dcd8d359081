"""Identification of the galvo servos: bandwidth, damping, delay and slew limit from measured steps."""
