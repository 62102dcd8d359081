"""The board's protocol, sans-I/O: framing, messages, the connection, quantisation."""
