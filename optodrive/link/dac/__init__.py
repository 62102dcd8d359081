"""Laser DACs that can be bought: encoding, verification and playback, one for all devices."""
