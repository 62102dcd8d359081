"""The engine: planning, queueing and execution of plans on one board session."""
