"""The front end: accepts connections, orders them with STOP first, and serves HTTP and WebSocket within bounds."""
