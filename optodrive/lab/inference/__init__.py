"""Decision on the claims that measured data permit."""
