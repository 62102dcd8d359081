"""Engine of the daemon: planning, queueing and execution of plans on one board session."""
