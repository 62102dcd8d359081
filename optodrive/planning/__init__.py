"""From requested tactile stimuli to a pulse plan that keeps every limit; no board involved."""
