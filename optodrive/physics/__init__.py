"""The pixel and the display in equations: closed forms, parameter sets with their sources."""
