"""A token-bucket rate limiter with one bucket per caller."""

from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass

CALLERS_MAX = 1024
"""The number of callers with a bucket; the bucket of the caller with the oldest request is dropped first."""


@dataclass
class _Bucket:
    tokens: float
    updated_s: float


class RateLimiter:
    """Limits each caller to `per_s` requests per second on average and `burst` at once."""

    def __init__(self, per_s: float, burst: float) -> None:
        self._per_s = per_s
        self._burst = max(burst, 1.0)
        self._buckets: OrderedDict[Hashable, _Bucket] = OrderedDict()

    def acquire(self, caller: Hashable, now_s: float) -> float:
        """Take one token: return 0 if there is one, else the time until there is, s."""
        bucket = self._buckets.pop(caller, None) or _Bucket(self._burst, now_s)
        bucket.tokens = min(self._burst, bucket.tokens + (now_s - bucket.updated_s) * self._per_s)
        bucket.updated_s = now_s
        self._buckets[caller] = bucket
        while len(self._buckets) > CALLERS_MAX:
            self._buckets.popitem(last=False)
        if bucket.tokens < 1.0:
            return (1.0 - bucket.tokens) / self._per_s
        bucket.tokens -= 1.0
        return 0.0
