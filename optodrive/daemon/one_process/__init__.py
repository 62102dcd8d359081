"""Engine of the daemon in one process, until its parts have moved to processes of their own."""
