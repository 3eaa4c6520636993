"""Limits on requests per key and on wrong keys per address: token buckets in this process."""

from __future__ import annotations

import ipaddress
import math
import time
from collections.abc import Callable

from app.errors import TooManyRequests

_MAX_BUCKETS = 10_000


class RateLimit:
    """Token buckets by owner. A bucket is stored as the time when it will be full again (GCRA, ITU-T I.371).

    Not thread-safe: only the event loop uses it.

    Parameters
    ----------
    per_s : float
        Tokens added per second, > 0. [1/s]
    at_once : int
        Tokens in a full bucket, >= 1.
    name : str
        Name of the policy in headers.
    message : str
        Message of a refusal.
    cure : str
        What the client can do.
    now_s : callable
        A monotonic clock. [s]
    """

    def __init__(
        self,
        per_s: float,
        at_once: int,
        *,
        name: str,
        message: str,
        cure: str,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._token_s = 1.0 / per_s
        self._bucket_s = at_once * self._token_s
        self._limit = f"{at_once} at once, then {per_s:.3g}/s"
        self._name, self._message, self._cure = name, message, cure
        self._now_s = now_s
        self._full_at_s: dict[str, float] = {}
        self.policy = f'"{name}";q={at_once};w={math.ceil(self._bucket_s)}'.encode()
        """Value of the header RateLimit-Policy (draft-ietf-httpapi-ratelimit-headers-10)."""

    def take(self, owner: str) -> bytes:
        """Take a token from an owner's bucket.

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
        self._keep(owner, full_at_s, now_s)
        left = int(left_s / self._token_s + 1e-6)
        return f'"{self._name}";r={left};t={math.ceil(full_at_s - now_s)}'.encode()

    def check(self, owner: str) -> None:
        """Refuse an owner whose bucket is empty, without taking a token.

        Raises
        ------
        TooManyRequests
            It is.
        """
        if self.is_spent(owner):
            raise self._refusal(self._wait_s(owner))

    def is_spent(self, owner: str) -> bool:
        """Whether an owner's bucket is empty."""
        return self._wait_s(owner) > 1e-9

    def reserve_s(self, owner: str) -> float:
        """Take a token, or the one that comes after those that others wait for; returns the time until it comes. [s]"""
        wait_s = max(0.0, self._wait_s(owner))
        self.charge(owner, 1.0)
        return wait_s

    def _wait_s(self, owner: str) -> float:
        return self._full_at_s.get(owner, 0.0) - self._now_s() + self._token_s - self._bucket_s

    def charge(self, owner: str, tokens: float) -> None:
        """Take tokens that were used already; the bucket may be overdrawn, and `check` then refuses."""
        now_s = self._now_s()
        self._keep(owner, max(self._full_at_s.get(owner, 0.0), now_s) + tokens * self._token_s, now_s)

    def _keep(self, owner: str, full_at_s: float, now_s: float) -> None:
        if owner not in self._full_at_s and len(self._full_at_s) >= _MAX_BUCKETS:
            self._forget(now_s)
        self._full_at_s[owner] = full_at_s

    def _refusal(self, wait_s: float) -> TooManyRequests:
        return TooManyRequests(
            self._message, limit=self._limit, cure=self._cure, retry_after_s=max(1, math.ceil(wait_s))
        )

    def _forget(self, now_s: float) -> None:
        """Delete full buckets, which equal new ones; if there are none, delete the oldest tenth."""
        full = [owner for owner, at_s in self._full_at_s.items() if at_s <= now_s]
        for owner in full or list(self._full_at_s)[: _MAX_BUCKETS // 10]:
            del self._full_at_s[owner]


def address_of(host: str) -> str:
    """Addresses whose wrong keys are counted together: an IPv4 address, or an IPv6 network of 64 bits."""
    if ":" not in host:
        return host
    try:
        return str(ipaddress.ip_network((host.partition("%")[0], 64), strict=False))
    except ValueError:
        return host
