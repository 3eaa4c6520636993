"""How many requests may come from one key, and how many wrong keys from one address: token buckets of this process."""

from __future__ import annotations

import ipaddress
import math
import time
from collections.abc import Callable

from app.errors import TooManyRequests

_MOST_BUCKETS = 10_000


class RateLimit:
    """Token buckets by whom they belong to. What is kept of a bucket is when it will be full again (GCRA, ITU-T I.371).

    Not for several threads: the event loop asks.

    Parameters
    ----------
    per_s : float
        Tokens that come back, > 0. [1/s]
    at_once : int
        Tokens in a full bucket, >= 1.
    name : str
        Of the policy, in headers.
    said : str
        What a refusal says there are too many of.
    cure : str
        What helps.
    now_s : callable
        A clock that never goes back. [s]
    """

    def __init__(
        self,
        per_s: float,
        at_once: int,
        *,
        name: str,
        said: str,
        cure: str,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._token_s = 1.0 / per_s
        self._bucket_s = at_once * self._token_s
        self._limit = f"{at_once} at once, then {per_s:.3g}/s"
        self._name, self._said, self._cure = name, said, cure
        self._now_s = now_s
        self._full_at_s: dict[str, float] = {}
        self.policy = f'"{name}";q={at_once};w={math.ceil(self._bucket_s)}'.encode()
        """Value of the header RateLimit-Policy (draft-ietf-httpapi-ratelimit-headers-10)."""

    def take(self, owner: str) -> bytes:
        """Take a token out of somebody's bucket.

        Returns
        -------
        bytes
            Value of the header RateLimit: tokens left, and seconds until the bucket is full again.

        Raises
        ------
        TooManyRequests
            The bucket is empty.
        """
        now_s = self._now_s()
        full_at_s = max(self._full_at_s.get(owner, 0.0), now_s) + self._token_s
        left_s = self._bucket_s - (full_at_s - now_s)
        if left_s < -1e-9:
            raise self._refusal(-left_s)
        if owner not in self._full_at_s and len(self._full_at_s) >= _MOST_BUCKETS:
            self._forget(now_s)
        self._full_at_s[owner] = full_at_s
        left = int(left_s / self._token_s + 1e-6)
        return f'"{self._name}";r={left};t={math.ceil(full_at_s - now_s)}'.encode()

    def check(self, owner: str) -> None:
        """Refuse somebody whose bucket is empty, and take nothing.

        Raises
        ------
        TooManyRequests
            It is.
        """
        wait_s = self._full_at_s.get(owner, 0.0) - self._now_s() + self._token_s - self._bucket_s
        if wait_s > 1e-9:
            raise self._refusal(wait_s)

    def _refusal(self, wait_s: float) -> TooManyRequests:
        return TooManyRequests(self._said, limit=self._limit, cure=self._cure, retry_after_s=max(1, math.ceil(wait_s)))

    def _forget(self, now_s: float) -> None:
        """Forget full buckets, which are as good as new ones; if there are none, the tenth that was made first."""
        full = [owner for owner, at_s in self._full_at_s.items() if at_s <= now_s]
        for owner in full or list(self._full_at_s)[: _MOST_BUCKETS // 10]:
            del self._full_at_s[owner]


def address_of(host: str) -> str:
    """Whose wrong keys are counted together: an IPv4 address, or a customer's IPv6 network of 64 bits."""
    if ":" not in host:
        return host
    try:
        return str(ipaddress.ip_network((host.partition("%")[0], 64), strict=False))
    except ValueError:
        return host
