"""Measured data against the model: what it gets wrong, which cause explains it, and what that gains."""
