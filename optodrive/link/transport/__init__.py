"""Transports: byte streams to a board."""
