"""The API: routes, access control, audit, and the connections to the other processes that answer."""
