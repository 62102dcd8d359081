"""Drivers of laser DACs."""
