"""Helios laser DAC: encoding, USB driver, verification and playback."""
