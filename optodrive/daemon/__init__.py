"""Daemon: the engine and its REST interface."""
