"""Spots by camera: pictures of a grid in the display's plane, and of the beam on that plane, to positions in metres."""
