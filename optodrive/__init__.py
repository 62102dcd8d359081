"""Driver of a tactile display driven by projected light."""

__version__ = "1.0.0"
