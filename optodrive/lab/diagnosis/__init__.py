"""Diagnosis of model errors from measured data: detection, cause, parameters and held-out gain."""
