"""Bringing a display up: homing the mirrors, measuring where the beam lands. It holds the board itself, no daemon."""
