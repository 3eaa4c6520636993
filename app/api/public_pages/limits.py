"""Limits on requests without a key: pages and damage reports by address, damage reports by marker."""

from __future__ import annotations

from dataclasses import dataclass

from fastapi import Request

from app.api.http.rate_limits import RateLimit, address_of

_MISS_COST = 5.0
"""Pages that an address which has no page counts as. Source: chosen by hand; who follows a QR code asks for one."""
_CURE = "wait for the time in Retry-After"


@dataclass(frozen=True, slots=True)
class PublicLimits:
    """Token buckets; None: as many as they like. For the event loop only."""

    pages: RateLimit | None
    reports: RateLimit | None
    of_marker: RateLimit | None

    def take_page(self, request: Request) -> None:
        """Count a page.

        Raises
        ------
        TooManyRequests
            The address asked for too many.
        """
        if self.pages is not None:
            self.pages.take(_address(request))

    def charge_miss(self, request: Request) -> None:
        """Count an address without a page as several: nobody is to try many."""
        if self.pages is not None:
            self.pages.charge(_address(request), _MISS_COST - 1.0)

    def take_report(self, request: Request) -> None:
        """Count a damage report of an address, before its body is read.

        Raises
        ------
        TooManyRequests
            The address sent too many.
        """
        if self.reports is not None:
            self.reports.take(_address(request))

    def take_report_of(self, marker_id: str) -> None:
        """Count a damage report of a marker that is complete.

        Raises
        ------
        TooManyRequests
            Too many were sent.
        """
        if self.of_marker is not None:
            self.of_marker.take(marker_id)


def public_limits(pages_per_minute: float, reports_per_hour: float, of_marker_per_day: float) -> PublicLimits:
    """Limits from the settings; 0 is none. A minute's, an hour's and a day's worth may come at once."""
    return PublicLimits(
        _limit(pages_per_minute, 60.0, "pages", "too many pages were asked for from this address"),
        _limit(reports_per_hour, 3600.0, "reports", "too many damage reports were sent from this address"),
        _limit(of_marker_per_day, 86400.0, "marker-reports", "too many damage reports of this marker were sent"),
    )


def _limit(number: float, in_s: float, name: str, message: str) -> RateLimit | None:
    if not number:
        return None
    return RateLimit(number / in_s, max(1, round(number)), name=name, message=message, cure=_CURE)


def _address(request: Request) -> str:
    return address_of(request.client.host) if request.client else "unknown"
