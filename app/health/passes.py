"""What one upload shows of a marker, and what remains of it as evidence after the vehicle's own errors."""

from __future__ import annotations

from dataclasses import dataclass

LonLat = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Pass:
    """What one upload of a vehicle shows of one marker.

    Attributes
    ----------
    marker_id, family : str
    read : bool
        Whether the marker was read.
    expected : float
        Probability that a healthy, clean marker is read in such a pass; 0 where it is not known.
    along : float
        Order in the drive: time, frame or odometer.
    offset_m : (float, float) or None
        Observed less registered position by the vehicle's own position, east and north. [m]
    sigma_m : float
        Standard deviation of the observation relative to the vehicle, each axis. [m]
    position_sigma_m : float or None
        Standard deviation of the vehicle's own position, each axis; None if unknown. [m]
    offset_is_absolute : bool
        The offset rests on no position of the vehicle: by a marker's own message.
    survey_m : float
        Standard deviation of the registered position, each axis. [m]
    heading_deg : float or None
        Of the vehicle. [deg]
    reversed : bool or None
        Whether it was met against its direction; None where it shows none.
    quality : float or None
        Signal or grade less the nominal one, in standard deviations.
    quality_is_relative : bool
        The quality is compared with the other markers of the drive already.
    elsewhere : (float, float) or None
        Where it was read, far from its place: longitude and latitude. [deg]
    two_places : bool
        One drive received it from two places.
    """

    marker_id: str
    family: str
    read: bool
    expected: float = 0.0
    along: float = 0.0
    offset_m: tuple[float, float] | None = None
    sigma_m: float = 0.0
    position_sigma_m: float | None = None
    offset_is_absolute: bool = False
    survey_m: float = 0.0
    heading_deg: float | None = None
    reversed: bool | None = None
    quality: float | None = None
    quality_is_relative: bool = False
    elsewhere: LonLat | None = None
    two_places: bool = False


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence of a pass on its marker after the vehicle's own errors.

    Attributes
    ----------
    read_probability : float
        That this vehicle reads a healthy, clean marker in this pass; 0 where a miss is no evidence.
    offset_m, sigma_m : (float, float) or None, float
        Less the drive's common shift, east and north, and the standard deviation of each with that of the shift. [m]
    reversed : bool or None
        Against the direction of the other markers of the drive.
    alone : bool
        The drive shows no other direction to compare with.
    quality : float or None
        Less that of the drive's other markers, in standard deviations.
    """

    marker_id: str
    family: str
    read: bool
    read_probability: float
    offset_m: tuple[float, float] | None = None
    sigma_m: float = 0.0
    survey_m: float = 0.0
    reversed: bool | None = None
    alone: bool = False
    quality: float | None = None
    elsewhere: LonLat | None = None
    two_places: bool = False
