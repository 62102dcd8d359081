"""Campaigns that measure for themselves: play, diagnose, choose the next experiment, until one explanation is left."""
