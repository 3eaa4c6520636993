"""Results of units of a proof, as they are stored: one JSON object a unit."""

from __future__ import annotations

from typing import TypedDict


class MarkerPass(TypedDict):
    """One pass of one drive over one marker.

    Attributes
    ----------
    marker : int
        Number in the plan.
    weight : float
        How many markers of its stratum it stands for.
    lost : bool
        It is missing in this drive.
    readable, seen, read : int
        Of plates: frames in which it is in view and a unit is a pixel high or more; of them, those that were rendered
        (no more than it takes to read it in `plates.min_frames`), and those in which it was read. Of magnets: 1, 1,
        and whether it was read.
    fix_m : list of float or None
        Error of the vehicle's position along and across the lane. [m]
    cause : str or None
        Why it was not read.
    """

    marker: int
    weight: float
    lost: bool
    readable: int
    seen: int
    read: int
    fix_m: list[float] | None
    cause: str | None


class WrongReading(TypedDict):
    """Something that was read and is not there: what, and the number of the marker that was being passed."""

    marker: int
    text: str


class LanePath(TypedDict):
    """Path of one drive along a stretch of lane with CERPMs, against the true centre line.

    Attributes
    ----------
    places : int
        Places of the true centre line between the first and the last marker.
    covered : int
        Of them, those within 1 m of the path.
    square_sum_m2, worst_m : float
        Of the distances of the covered places from the path. [m2, m]
    worst_at_m : float
        Chainage of the greatest distance. [m]
    heard, markers : int
        Markers that were received and verified, of those along the stretch.
    left_out : list of int
        Numbers of markers that the path leaves out.
    refusal : str or None
        Why there is no path.
    """

    places: int
    covered: int
    square_sum_m2: float
    worst_m: float
    worst_at_m: float
    heard: int
    markers: int
    left_out: list[int]
    refusal: str | None


class UnitResult(TypedDict):
    """Result of one unit.

    Attributes
    ----------
    key : str
        Of the unit.
    kind, drive, lane
        As in the unit.
    condition, camera : str
        Of the drive.
    weight : float
        Of a stretch: how many of its kind it stands for.
    passes : list of MarkerPass
    wrong : list of WrongReading
    path : LanePath or None
        Of a lane with CERPMs.
    """

    key: str
    kind: str
    drive: int
    lane: str
    condition: str
    camera: str
    weight: float
    passes: list[MarkerPass]
    wrong: list[WrongReading]
    path: LanePath | None
