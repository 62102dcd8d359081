"""Per-pixel gain and beam offset from measured heights."""
