"""Measurement of the beam's spots by camera, from pictures of a grid and of the beam in the display's plane."""
