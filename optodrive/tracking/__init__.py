"""Trackers of fingertips: a multitouch film and a camera."""
