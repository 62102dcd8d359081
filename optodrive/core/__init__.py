"""Types, errors, units, clock, files and compiled kernels that every other package uses."""
