"""The treatment of stimuli that exceed a cap."""

from typing import Literal

Policy = Literal["trim", "delay", "refuse"]
"""Reduce the pulses that exceed a cap, delay them until they fit, or refuse the sequence."""
