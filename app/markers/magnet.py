"""The magnet tag: magnets, line tags and information tags as values, and their text form.

Source: METRO paper (Wang et al., SenSys 2023, doi 10.1145/3625687.3625809), section 4, and docs/nomenclature.md.

A magnet is upright (phi = 90, ``N``: north pole up) or lies along the lane (phi = 0, ``N``: north pole forward in the
direction of legal travel). A line tag {P, 90} marks a painted line. An information tag {P, 0, M, L, Seg_d, r} is a row
of M magnets along a lane: the first and the last are L apart, the others stand on a grid of Seg_d between them.

Tag frame: metres from the first magnet, along the lane in the direction of travel, and to the left.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from enum import IntEnum, StrEnum
from itertools import pairwise
from typing import Annotated

from pydantic import Field, with_config

from app.errors import CodeMismatch, InvalidParameter
from app.inputs import INPUT, Number

MAGNETS = (2, 7)
"""Smallest and largest number of magnets of an information tag. Source: METRO section 4.2 (two reference nodes) and
figure 5a, which ends at seven."""
LENGTH_M = (0.5, 30.0)
"""Shortest and longest tag. [m] Source: `MIN_GAP_M`, and by hand; METRO's figure 5 ends below."""
SEGMENT_M = (0.02, 30.0)
"""Smallest and largest segmentation distance. [m] Source: METRO tested down to 0.02 m, hardly more than a magnet's own
length; a segment is no longer than the tag."""
MIN_GAP_M = 0.5
"""Smallest distance of neighbouring magnets whose fields do not couple. [m] Source: METRO figure 17a, whose capacities
follow from it exactly."""
MAX_LINE_SPACING_M = 6.0
"""Largest distance between the magnets of a line. [m] Source: METRO section 6.3."""
MOMENT_AM2 = 2.47
"""Moment of METRO's magnet: an N52 cuboid of 15 x 15 x 9.5 mm (METRO section 6.2) with a remanence of 1.45 T. [A m2]
Source: remanence times volume over mu0."""
FIELD_UT_M3 = 0.1
"""mu0 / (4 pi), the field of a dipole of 1 A m2 at 1 m across its axis. [uT m3 / (A m2)] Source: SI."""

HALF_HEIGHT_M = 0.005
"""From the bottom of a magnet to its centre. [m] Source: half of METRO's 9.5 mm (section 6.2), and the glue."""
SHELL_HEIGHT_MM = 15.0
"""Height of a shell on the road, where none is stated. [mm] Source: by hand, the magnet's 9.5 mm and 5 mm of shell;
METRO calls its shell thin (section 8.2) and gives no height."""

_TICKS_PER_M = 10_000
"""Lengths are whole tenths of a millimetre. Exact to count with and fine enough for inches."""
_SOURCE = "METRO paper, section 4.2"
_INFORMATION = re.compile(
    r"(?P<polarities>[NS]{1,16})_(?P<length>\d{1,3}(\.\d{1,4})?)_(?P<segment>\d{1,3}(\.\d{1,4})?)"
    r"_(?P<gaps>\d{1,5}(-\d{1,5}){0,15})",
    re.ASCII,
)
_LINE = re.compile(r"(?P<polarity>[NS])_90")
_TEXT_LIMIT = "N_90 or S_90, or POLARITIES_LENGTH_SEGMENT_GAPS as in SNS_4_0.1_10-30"


class Polarity(StrEnum):
    """Which way a magnet's north pole points: ``N`` up (phi = 90) or forward (phi = 0), ``S`` the other way."""

    N = "N"
    S = "S"

    @property
    def flipped(self) -> Polarity:
        """The other polarity."""
        return Polarity.S if self is Polarity.N else Polarity.N

    @property
    def sign(self) -> int:
        """1 for ``N``, -1 for ``S``."""
        return 1 if self is Polarity.N else -1


class Orientation(IntEnum):
    """Angle phi between a magnet's axis and the road. [deg]"""

    FORWARD = 0
    UP = 90

    @property
    def phi_deg(self) -> int:
        """The angle. [deg]"""
        return self.value


class LineStyle(StrEnum):
    """What a line tag stands for (METRO section 4.1)."""

    SOLID = "solid"
    DASHED = "dashed"


class MagnetMounting(StrEnum):
    """How magnets are fixed: in drilled holes, or in shells that are glued onto the road (METRO section 8.2)."""

    HOLE = "hole"
    SURFACE = "surface"


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class Installation:
    """How the magnets of a layout are fixed in or on the road, and so how deep they lie.

    Raises
    ------
    InvalidParameter
        A size does not belong to the mounting.
    """

    mounting: Annotated[
        MagnetMounting, Field(description="`hole`: drilled; `surface`: in shells that are glued onto the road.")
    ] = MagnetMounting.HOLE
    hole_diameter_mm: Annotated[
        Number | None,
        Field(ge=22.0, le=200.0, description="A bare METRO magnet of 15 x 15 x 9.5 mm needs at least 22 mm."),
    ] = None
    hole_depth_mm: Annotated[
        Number | None,
        Field(
            ge=10.0, le=300.0, description="From the road's surface to the bottom of the hole; adds to the clearance."
        ),
    ] = None
    shell_height_mm: Annotated[
        Number | None,
        Field(ge=10.0, le=50.0, description=f"Of a shell above the road; without, {SHELL_HEIGHT_MM:g} mm."),
    ] = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "mounting", MagnetMounting(self.mounting))
        other = ("hole_diameter_mm", "hole_depth_mm") if self.on_surface else ("shell_height_mm",)
        for name in other:
            if getattr(self, name) is not None:
                raise InvalidParameter(
                    f"{name} means nothing for magnets with the mounting {self.mounting}",
                    field=name,
                    limit="hole_diameter_mm and hole_depth_mm: hole; shell_height_mm: surface",
                    cure=f"leave {name} out, or choose the mounting {'hole' if self.on_surface else 'surface'}",
                )

    @property
    def on_surface(self) -> bool:
        """Whether nothing is drilled."""
        return self.mounting is MagnetMounting.SURFACE

    @property
    def depth_m(self) -> float:
        """Depth of a magnet's centre below the road, negative above it. [m]

        A magnet stands on the bottom of its hole. Where the hole's depth is not stated, it counts as standing on the
        road.
        """
        return (self.hole_depth_mm or 0.0) / 1000 - HALF_HEIGHT_M

    @property
    def height_mm(self) -> float:
        """How far the magnets stand out of the road. [mm]"""
        return (self.shell_height_mm or SHELL_HEIGHT_MM) if self.on_surface else 0.0

    def distance_m(self, clearance_m: float) -> float:
        """Distance from sensors at a clearance above the road down to the centre of a magnet. [m]"""
        return clearance_m + self.depth_m

    @property
    def text(self) -> str:
        """For people; empty where nothing is stated."""
        if self.on_surface:
            return f"on the surface, in shells {self.height_mm:g} mm high"
        sizes = (("diameter", self.hole_diameter_mm), ("depth", self.hole_depth_mm))
        found = ", ".join(f"{name} {size:g} mm" for name, size in sizes if size is not None)
        return f"holes: {found}" if found else ""


@dataclass(frozen=True, slots=True)
class Magnet:
    """One magnet of a tag."""

    # `along_m`, `lateral_m`: [m] in the tag frame: along the lane in the direction of travel, and to the left
    along_m: float
    lateral_m: float
    polarity: Polarity
    orientation: Orientation


@dataclass(frozen=True, slots=True)
class LineTag:
    """A magnet on a painted line, {P, 90}: ``N`` on a solid, ``S`` on a dashed line."""

    polarity: Polarity

    def __post_init__(self) -> None:
        object.__setattr__(self, "polarity", _polarity(self.polarity))

    @classmethod
    def of_style(cls, style: LineStyle) -> LineTag:
        """The tag of a kind of line."""
        return cls(Polarity.N if style is LineStyle.SOLID else Polarity.S)

    @property
    def style(self) -> LineStyle:
        """The kind of line."""
        return LineStyle.SOLID if self.polarity is Polarity.N else LineStyle.DASHED

    @property
    def magnets(self) -> tuple[Magnet, ...]:
        """The magnet, in the tag frame."""
        return (Magnet(0.0, 0.0, self.polarity, Orientation.UP),)

    @property
    def text(self) -> str:
        """Canonical form, e.g. ``N_90``; `parse_tag` reads it."""
        return f"{self.polarity}_90"

    @property
    def tuple_text(self) -> str:
        """As the paper writes it, e.g. ``{N, 90°}``."""
        return f"{{{self.polarity}, 90°}}"

    def reversed_wrong_way(self) -> LineTag:
        """What a wrong-way driver meets: the same, up is up."""
        return self


@dataclass(frozen=True, slots=True)
class InformationTag:
    """A row of magnets along a lane that carries a code, {P, 0, M, L, Seg_d, r}.

    Raises
    ------
    InvalidParameter
        A value is outside these limits; lengths are whole tenths of a millimetre.

    Notes
    -----
    Neighbours nearer than 0.5 m are allowed here, as in the paper's equation 2; the checks of a layout refuse them.
    """

    polarities: tuple[Polarity, ...]  # first magnet first, 2 to 7 of them. A string such as ``"SNS"`` is taken too.
    length_m: float  # [m] L, from the first magnet to the last: a whole number of segments
    segment_m: float  # [m] Seg_d, the grid on which the middle magnets stand
    # grid positions of the middle magnets, counted from the first magnet: rising, between 1 and L/Seg_d - 1
    positions: tuple[int, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "polarities", tuple(_polarity(p) for p in self.polarities))
        object.__setattr__(self, "positions", tuple(self.positions))
        check_magnet_count(self.magnet_count, "polarities")
        n = segments_in(self.length_m, self.segment_m)
        object.__setattr__(self, "length_m", rounded_m(self.length_m, "length_m"))
        object.__setattr__(self, "segment_m", rounded_m(self.segment_m, "segment_m"))
        if len(self.positions) != self.magnet_count - 2:
            raise InvalidParameter(
                f"{self.magnet_count} magnets have {self.magnet_count - 2} between the first and the last, "
                f"not {len(self.positions)}",
                field="positions",
                limit=f"{self.magnet_count - 2} positions",
                cure="give a grid position for each middle magnet",
            )
        if any(type(p) is not int for p in self.positions) or any(
            not a < b for a, b in pairwise((0, *self.positions, n))
        ):
            raise InvalidParameter(
                f"middle magnets stand at {list(self.positions)}, which are not rising grid positions inside the tag",
                field="positions",
                limit=f"whole numbers, rising, 1 to {n - 1}",
                cure=f"a tag of {self.length_m:g} m in segments of {self.segment_m:g} m has {n - 1} places: {_SOURCE}",
            )

    @classmethod
    def from_gaps(
        cls, polarities: str | Sequence[Polarity], segment_m: float, gap_steps: Sequence[int]
    ) -> InformationTag:
        """Tag whose neighbouring magnets stand so many segments apart, length M - 1.

        Raises
        ------
        InvalidParameter
            The gaps or what follows from them are outside the limits of a tag.
        """
        if not gap_steps or any(type(g) is not int or g < 1 for g in gap_steps):
            raise InvalidParameter(
                f"the gaps {list(gap_steps)} are not one or more segments each",
                field="gap_steps",
                limit="whole numbers from 1",
            )
        ends = [sum(gap_steps[: i + 1]) for i in range(len(gap_steps))]
        length_m = ends[-1] * ticks_from_m(segment_m, "segment_m") / _TICKS_PER_M
        return cls(tuple(_polarity(p) for p in polarities), length_m, segment_m, tuple(ends[:-1]))

    @property
    def magnet_count(self) -> int:
        """M."""
        return len(self.polarities)

    @property
    def segments(self) -> int:
        """L / Seg_d."""
        return segments_in(self.length_m, self.segment_m)

    @property
    def gap_steps(self) -> tuple[int, ...]:
        """Distances from each magnet to the next, in segments, length M - 1."""
        return tuple(b - a for a, b in pairwise((0, *self.positions, self.segments)))

    @property
    def gaps_m(self) -> tuple[float, ...]:
        """Distances d_1 .. d_(M-1) from each magnet to the next. [m]"""
        step = ticks_from_m(self.segment_m, "segment_m")
        return tuple(g * step / _TICKS_PER_M for g in self.gap_steps)

    @property
    def offsets_m(self) -> tuple[float, ...]:
        """Places of the magnets in the tag frame, length M; the first is 0. [m]"""
        step = ticks_from_m(self.segment_m, "segment_m")
        return tuple(p * step / _TICKS_PER_M for p in (0, *self.positions, self.segments))

    @property
    def ratios(self) -> tuple[float, ...]:
        """Distance ratios d_2/d_1 .. d_(M-1)/d_1, length M - 2 (equation 1 and figure 3b): one for three magnets."""
        first, *rest = self.gap_steps
        return tuple(g / first for g in rest)

    @property
    def magnets(self) -> tuple[Magnet, ...]:
        """The magnets, in the tag frame."""
        return tuple(
            Magnet(along, 0.0, polarity, Orientation.FORWARD)
            for along, polarity in zip(self.offsets_m, self.polarities, strict=True)
        )

    @property
    def text(self) -> str:
        """Canonical form, e.g. ``SNS_4_0.1_10-30``: polarities, length, segment [m], gaps in segments."""
        gaps = "-".join(str(g) for g in self.gap_steps)
        return f"{''.join(self.polarities)}_{_metres(self.length_m)}_{_metres(self.segment_m)}_{gaps}"

    @property
    def tuple_text(self) -> str:
        """As the paper writes it, e.g. ``{SNS, 0°, 3, 4, 1, 3/1}``; r is d_2/d_1, or all distances for M > 3."""
        steps = [str(g) for g in self.gap_steps]
        ratio = {2: "-", 3: "/".join(reversed(steps))}.get(self.magnet_count, ":".join(steps))
        head = f"{''.join(self.polarities)}, 0°, {self.magnet_count}"
        return f"{{{head}, {_metres(self.length_m)}, {_metres(self.segment_m)}, {ratio}}}"

    def reversed_wrong_way(self) -> InformationTag:
        """The tag as a wrong-way driver meets it: last magnet first, each north pole pointing the other way."""
        return InformationTag(
            tuple(p.flipped for p in reversed(self.polarities)),
            self.length_m,
            self.segment_m,
            tuple(self.segments - p for p in reversed(self.positions)),
        )


Tag = LineTag | InformationTag


def parse_tag(text: str) -> Tag:
    """Tag of a canonical text, as `LineTag.text` and `InformationTag.text` write it.

    Raises
    ------
    CodeMismatch
        The text has another form, or its gaps do not add up to its length.
    InvalidParameter
        It describes a tag outside the limits.
    """
    if line := _LINE.fullmatch(text):
        return LineTag(Polarity(line["polarity"]))
    found = _INFORMATION.fullmatch(text)
    if not found:
        raise CodeMismatch(
            f"{text[:60]!r} is not a magnet tag",
            field="code",
            limit=_TEXT_LIMIT,
            cure="write polarities, length and segment in metres, and the gaps in segments",
        )
    length_m, segment_m = float(found["length"]), float(found["segment"])
    steps = [int(g) for g in found["gaps"].split("-")]
    n = segments_in(length_m, segment_m)
    if sum(steps) != n:
        raise CodeMismatch(
            f"the gaps of {text} add up to {sum(steps)} segments, its length is {n}",
            field="code",
            limit=f"gaps that add up to {n}",
            cure="correct the gaps or the length",
        )
    tag = InformationTag.from_gaps(found["polarities"], segment_m, steps)
    if tag.text != text:
        raise CodeMismatch(
            f"{text} is written {tag.text}",
            field="code",
            limit=_TEXT_LIMIT,
            cure="leave out leading and trailing zeros",
        )
    return tag


# --- limits -------------------------------------------------------------------------------------------------------


def check_magnet_count(count: int, field: str = "magnets") -> None:
    """Refuse a number of magnets that no information tag has."""
    low, high = MAGNETS
    if type(count) is not int or not low <= count <= high:
        raise InvalidParameter(
            f"an information tag has {low} to {high} magnets, not {count}: {_SOURCE}",
            field=field,
            limit=f"{low} to {high}",
            cure=f"choose M between {low} and {high}",
        )


def segments_in(length_m: float, segment_m: float) -> int:
    """L / Seg_d, exactly.

    Raises
    ------
    InvalidParameter
        A length is outside its limits, or L is not a whole number of segments: then the last magnet would stand off
        the grid, and the tag would be another one when read from behind.
    """
    _check_length("length_m", length_m, LENGTH_M)
    _check_length("segment_m", segment_m, SEGMENT_M)
    whole, rest = divmod(ticks_from_m(length_m, "length_m"), ticks_from_m(segment_m, "segment_m"))
    if rest or not whole:
        nearest = sorted({max(whole, 1), whole + 1})
        cure = " or ".join(_metres(k * segment_m) for k in nearest)
        raise InvalidParameter(
            f"{length_m:g} m is {length_m / segment_m:.4g} segments of {segment_m:g} m, not a whole number",
            field="length_m",
            limit="a whole number of segments",
            cure=f"choose a length of {cure} m, or another segment",
        )
    return whole


def ticks_from_m(value_m: float, field: str) -> int:
    """A length in whole tenths of a millimetre.

    Raises
    ------
    InvalidParameter
        It is not finite, or not a whole number of them.
    """
    scaled = value_m * _TICKS_PER_M
    if not abs(scaled) < 1e9 or abs(scaled - round(scaled)) > 1e-4:
        raise InvalidParameter(
            f"{field} is {value_m} m, which is not a whole number of tenths of a millimetre",
            field=field,
            limit="a multiple of 0.0001 m",
            cure="round it to 0.0001 m",
        )
    return round(scaled)


def rounded_m(value_m: float, field: str) -> float:
    """The float next to a length in tenths of a millimetre, so that equal lengths compare equal. [m]"""
    return ticks_from_m(value_m, field) / _TICKS_PER_M


def _check_length(field: str, value_m: float, limits: tuple[float, float]) -> None:
    low, high = limits
    if not low <= value_m <= high:
        raise InvalidParameter(
            f"{field} is {value_m:g} m, tags have {low:g} to {high:g} m",
            field=field,
            limit=f"{low:g} to {high:g} m",
            cure=f"choose {field} between {low:g} and {high:g} m",
        )


def _polarity(value: str) -> Polarity:
    try:
        return Polarity(value)
    except ValueError as error:
        raise InvalidParameter(
            f"{str(value)[:20]!r} is not a polarity", field="polarities", limit="N or S", cure="write N or S"
        ) from error


def _metres(value_m: float) -> str:
    """Shortest text of a length, to the tenth of a millimetre."""
    text = f"{Decimal(round(value_m * _TICKS_PER_M)).scaleb(-4):f}"
    return text.rstrip("0").rstrip(".")
