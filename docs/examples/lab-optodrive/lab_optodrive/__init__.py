"""Pattern and term of a laboratory for optodrive."""
