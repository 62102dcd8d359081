"""Discovery: the terms that a simulation of ordinary differential equations lacks, found in measured records."""

from optodrive.lab.discovery.discovery import discover
from optodrive.lab.discovery.model import Curve, Discovery, Finding, OdeModel, Parameter, Record

__all__ = ["Curve", "Discovery", "Finding", "OdeModel", "Parameter", "Record", "discover"]
