"""Properties and bytes of the laser DACs."""
