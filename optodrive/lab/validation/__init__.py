"""Validation of the physics against the paper's facts, and search for the causes of its deviations."""
