"""Tactile frames to timed pulses: mirror angles, move times, drive, order."""
