"""Schedule and statistics of lease renewals."""

from optodrive.core.histogram import Histogram
from optodrive.link.protocol import messages as m

RENEWAL_FRACTION = 0.2
"""Interval between renewals as a fraction of the lease."""
AGE_BUCKETS_S = (0.01, 0.02, 0.025, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.2, 0.5, 1.0)


class LeaseRenewal:
    """Schedule of the renewals of one lease.

    ages: distribution of the time between renewals, s
    slack_s: minimum remaining lease at a renewal, None before the second renewal
    """

    def __init__(self, lease_s: float) -> None:
        self.ages = Histogram(AGE_BUCKETS_S)
        self.slack_s: float | None = None
        self._lease_s = lease_s
        self._sent_s = 0.0
        self._active = False

    def pause(self) -> None:
        """Stop the statistics while the board needs no lease."""
        self._active = False

    def renew(self, now_s: float) -> m.Lease | None:
        """Return the message of a renewal, None if no renewal is due."""
        age_s = now_s - self._sent_s
        if age_s < RENEWAL_FRACTION * self._lease_s:
            return None
        self._sent_s = now_s
        if self._active:
            self.ages.add(age_s)
            self.slack_s = min(self._lease_s if self.slack_s is None else self.slack_s, self._lease_s - age_s)
        self._active = True
        return m.Lease(ms=round(self._lease_s * 1e3))
