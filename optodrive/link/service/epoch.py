"""Epochs: periods between two events that stop the light."""

STOP, DISARM = "ended by stop", "ended by disarm"
"""Reasons of a caller who wants the light to end, for which a plan is stopped rather than failed."""


class Epoch:
    """The present epoch.

    number: greater than all earlier ones; reason: cause that has ended the one before, for people
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self.reason = "the link process has started"

    def end(self, reason: str) -> None:
        """Begin the next epoch. reason: cause that ends this one, as the end of a sentence."""
        self.number += 1
        self.reason = reason

    def is_current(self, number: int) -> bool:
        """Return whether points that were accepted in an epoch may be handed over: gate 1."""
        return number == self.number
