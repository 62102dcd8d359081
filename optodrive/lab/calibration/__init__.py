"""Where codes lead the beam: measured spots to a field, with how sure it is; display metres to codes and back."""
