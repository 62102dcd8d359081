"""The thermal budget: pulses are passed, trimmed or refused, each with its reason."""
