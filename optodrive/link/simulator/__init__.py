"""A board and a display that run here: bytes in, pulses and measurements out."""
