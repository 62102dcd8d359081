"""Spots by camera: pictures of a grid in the plane of the display, and of the beam on that plane, to metres."""
