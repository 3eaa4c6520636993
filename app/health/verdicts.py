"""What the tests of a marker find."""

from __future__ import annotations

from dataclasses import dataclass

from app.health.passes import LonLat
from app.health.rules import Fault


@dataclass(frozen=True, slots=True)
class Verdict:
    """A fault that is suspected by the evidence of several vehicles.

    Attributes
    ----------
    fault : Fault
    ratio, limit : float
        Logarithm of the likelihood ratio, and the limit that it has passed. [nat]
    vehicles, passes : int
        That added to it, and their passes where these are kept.
    since_s : float
        When the evidence began. [s since 1970]
    offset_m : (float, float) or None
        Estimated displacement, east and north. [m]
    elsewhere : (float, float) or None
        Where it was read, far from its place. [deg]
    """

    fault: Fault
    ratio: float
    limit: float
    vehicles: int
    passes: int
    since_s: float
    offset_m: tuple[float, float] | None = None
    elsewhere: LonLat | None = None
