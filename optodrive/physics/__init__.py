"""Physics of a pixel and of a display: closed forms, terms beyond them, parameter sets with their sources."""
