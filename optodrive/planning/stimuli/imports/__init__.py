"""Stimuli from files of other fields: haptic effects and sound."""
