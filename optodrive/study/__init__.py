"""Studies with people: designs, sessions that lose no trial, datasets, and simulated participants."""
