"""The scheduler: turns frames and trains into timed pulses, with visiting order, settling times and drive."""
