"""From a limited plan to executed pulses and back: protocol, transports, board session, laser DACs, simulator."""
