"""Types, errors, units, clock, files and compiled kernels, which every other package uses."""
