"""The machine as configured: display layout, scan field, servo and settling times."""
