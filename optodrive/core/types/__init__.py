"""The types that flow between packages: stimuli, plans, measurements, discrepancies."""
