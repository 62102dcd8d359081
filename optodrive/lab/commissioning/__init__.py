"""Commissioning of a display with exclusive access to the board: homing, and measurement of beam positions."""
