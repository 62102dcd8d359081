"""Types that packages exchange: stimuli, plans, measurements, discrepancies."""
