"""The host's session with a board: handshake, arming, credits, lease, clock, faults."""
