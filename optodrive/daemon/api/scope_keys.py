"""Keys under which the server tells the application who called and when."""

CALLER = "optodrive.caller"
"""Key in the ASGI scope of the token that the request presented, ANONYMOUS without one."""
ARRIVED_S = "arrived_s"
"""Key in the state of an ASGI scope, and in a WebSocket's message, of the monotonic time at which it arrived."""
EARLIEST_S = "earliest_s"
"""Key in a WebSocket's message of the earliest monotonic time at which it may have arrived."""
