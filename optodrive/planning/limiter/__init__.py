"""The limiter: passes, trims or refuses pulses by the thermal, energy and galvo caps, each with its reason."""
