"""Driver of a tactile display driven by projected light."""

__version__ = "0.1.0"
