"""Host session with a board: handshake, arming, flow control, lease, clock and faults."""
