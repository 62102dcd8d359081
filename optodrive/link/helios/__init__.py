"""A Helios laser DAC: its bytes, the board itself, the proof of a plan in its bytes, and the player."""
