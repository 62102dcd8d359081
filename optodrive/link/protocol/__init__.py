"""Board protocol, sans-I/O: framing, messages, connection and quantisation."""
