"""The link process: it alone opens the board's port, and serves STOP, arming and streaming to the other processes."""
