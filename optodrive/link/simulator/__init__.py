"""Simulated board and display: bytes in, pulses and measurements out."""
