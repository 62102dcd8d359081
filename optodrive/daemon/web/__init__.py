"""The REST, WebSocket and page interface of the daemon, and its access control."""
