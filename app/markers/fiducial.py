"""Square fiducial signs: dictionaries, codes and dimensions of ArUco and AprilTag signs.

Sources: Garrido-Jurado et al., Pattern Recognition 47(6), 2014 (ArUco); Olson, ICRA 2011, and Wang and Olson, IROS 2016
(AprilTag); the codewords are those of OpenCV's `cv2.aruco` module.

A sign is a black border, one module wide, round a square of n x n modules, on a white quiet zone. Sign frame:
millimetres from the centre, x to the right, y up on the face. The face of a lying sign looks up and its y is the
direction of travel; the face of an upright sign looks at the traffic that comes towards it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import Annotated

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field, with_config

from app.errors import CodeMismatch, InvalidParameter
from app.inputs import INPUT, Text

SIDE_MM = (30.0, 3000.0)
"""Of the black border's outer edge. [mm]"""
MAX_QUIET_MM = 1000.0


@dataclass(frozen=True, slots=True)
class FiducialDictionary:
    """A set of codewords."""

    name: str  # as markers are registered, at most 16 characters
    series: str  # dictionaries of one series share their codewords: 17 of `aruco-4x4-50` is 17 of `aruco-4x4-250`
    opencv: str  # name of the constant in `cv2.aruco`
    size: int  # how many codewords there are
    modules: int  # along a side, without the border


_SIZES = (50, 100, 250, 1000)
_LISTED = (
    *(
        FiducialDictionary(f"aruco-{n}x{n}-{size}", f"aruco-{n}x{n}", f"DICT_{n}X{n}_{size}", size, n)
        for n in (4, 5, 6, 7)
        for size in _SIZES
    ),
    FiducialDictionary("aruco-original", "aruco-original", "DICT_ARUCO_ORIGINAL", 1024, 5),
    FiducialDictionary("aruco-mip-36h12", "aruco-mip-36h12", "DICT_ARUCO_MIP_36h12", 250, 6),
    FiducialDictionary("apriltag-16h5", "apriltag-16h5", "DICT_APRILTAG_16h5", 30, 4),
    FiducialDictionary("apriltag-25h9", "apriltag-25h9", "DICT_APRILTAG_25h9", 35, 5),
    FiducialDictionary("apriltag-36h10", "apriltag-36h10", "DICT_APRILTAG_36h10", 2320, 6),
    FiducialDictionary("apriltag-36h11", "apriltag-36h11", "DICT_APRILTAG_36h11", 587, 6),
)
DICTIONARIES = {dictionary.name: dictionary for dictionary in _LISTED}


def get_dictionary(name: str) -> FiducialDictionary:
    """The dictionary with a name.

    Raises
    ------
    InvalidParameter
        There is none.
    """
    found = DICTIONARIES.get(name)
    if found is None:
        raise InvalidParameter(
            f"there is no dictionary {name[:40]!r}",
            field="dictionary",
            limit=", ".join(DICTIONARIES),
            cure="choose one of these",
        )
    return found


@lru_cache
def codewords(name: str) -> npt.NDArray[np.uint8]:
    """All codewords of a dictionary, dark = 1, shape (size, modules, modules)."""
    dictionary = get_dictionary(name)
    stored = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary.opencv))
    n = dictionary.modules
    light = [cv2.aruco.Dictionary.getBitsFromByteList(row[None], n) for row in stored.bytesList]
    words: npt.NDArray[np.uint8] = (1 - np.array(light, dtype=np.uint8)).astype(np.uint8)
    words.flags.writeable = False
    return words


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class FiducialCode:
    """The code of a sign: a codeword of a dictionary."""

    dictionary: Annotated[Text, Field(max_length=40, description="Such as `apriltag-36h11` or `aruco-4x4-50`.")]
    number: Annotated[int, Field(strict=True, ge=0, description="Of the codeword in the dictionary, from 0.")]

    def __post_init__(self) -> None:
        """Raises InvalidParameter if there is no such dictionary, CodeMismatch if it has fewer codewords."""
        size = get_dictionary(self.dictionary).size
        if not 0 <= self.number < size:
            raise CodeMismatch(
                f"{self.dictionary} has no codeword {self.number}",
                field="number",
                limit=f"0 to {size - 1}",
                cure="choose another number or a larger dictionary",
            )

    @classmethod
    def from_text(cls, text: str, dictionary: str) -> FiducialCode:
        """The code of a dictionary that is written as `text`: a number, or the series and a number.

        Raises
        ------
        CodeMismatch, InvalidParameter
            The text is not a code of this dictionary.
        """
        series, _, digits = text.rpartition("-")
        expected = get_dictionary(dictionary).series
        if not (digits.isascii() and digits.isdigit() and len(digits) <= 5) or series not in ("", expected):
            raise CodeMismatch(
                f"{text[:40]!r} is not a code of {dictionary}",
                field="code",
                limit=f"{expected}-NUMBER, or the number",
                cure="correct the code or the dictionary",
            )
        return cls(dictionary, int(digits))

    @property
    def text(self) -> str:
        """Series and number; signs with the same text look the same."""
        return f"{get_dictionary(self.dictionary).series}-{self.number}"

    @property
    def modules(self) -> npt.NDArray[np.uint8]:
        """The face with its border as OpenCV's image has it, dark = 1, shape (n + 2, n + 2)."""
        return np.pad(codewords(self.dictionary)[self.number], 1, constant_values=1)

    @property
    def has_two_images(self) -> bool:
        """Whether the sign may show the image of AprilTag's authors."""
        return self.dictionary.startswith("apriltag-")


class Mounting(StrEnum):
    """How a sign stands."""

    UPRIGHT = "upright"
    LYING = "lying"


class SignImage(StrEnum):
    """Whose image a sign shows the right way up.

    The images that AprilTag's authors publish are those of OpenCV turned by 180 degrees, in all dictionaries of
    AprilTag. That was the same in OpenCV 4.10 to 4.13 and 5.0, whatever refines the corners:
    tests/families/fiducial/test_real_tags.py reads the published images.
    """

    OPENCV = "opencv"
    APRILTAG = "apriltag"


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class FiducialGeometry:
    """Dimensions and mounting of a sign."""

    side_mm: float  # [mm] outer edge of the black border, 30 to 3000
    quiet_mm: float  # [mm] width of the white zone round the border, 0 to 1000
    mounting: Mounting = Mounting.UPRIGHT
    image: SignImage | None = None  # None: not stated; of ArUco there is only OpenCV's

    def __post_init__(self) -> None:
        """Raises InvalidParameter if a dimension is outside its limits."""
        for name, value, (low, high) in (
            ("side_mm", self.side_mm, SIDE_MM),
            ("quiet_mm", self.quiet_mm, (0.0, MAX_QUIET_MM)),
        ):
            if not low <= value <= high:
                raise InvalidParameter(
                    f"{name} is {value:g} mm",
                    field=name,
                    limit=f"{low:g} to {high:g} mm",
                    cure=f"choose {name} within these limits",
                )

    @property
    def corners_mm(self) -> npt.NDArray[np.float64]:
        """Outer corners of the border in the sign frame, clockwise from the upper left, shape (4, 2). [mm]"""
        half = self.side_mm / 2
        return np.array([(-half, half), (half, half), (half, -half), (-half, -half)])


@dataclass(frozen=True, slots=True)
class KnownFiducial:
    """A registered sign that a decoder may expect."""

    code: FiducialCode
    geometry: FiducialGeometry
