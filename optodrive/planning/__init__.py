"""Planning: turns requested stimuli into a pulse plan within all limits, without a board."""
