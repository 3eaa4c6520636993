"""The code requested for a plate: explicit, or derived from its position or its registry number."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from app.errors import CodeMismatch, InvalidParameter, naming
from app.families.plate.registration import CodeInput
from app.markers.plate import PlateCode, PlateScheme


@dataclass(frozen=True, slots=True)
class CodedPlate:
    """A code with its relation to the position.

    Attributes
    ----------
    code : PlateCode
    digits_match_position : bool or None
        None for registry numbers, and where no position is known.
    is_explicit : bool
        The request has the code, and it does not follow from the position.
    """

    code: PlateCode
    digits_match_position: bool | None
    is_explicit: bool


def coded_plate(
    wanted: CodeInput, n: int, place_deg: tuple[float, float] | None, allocate: Callable[[], PlateCode]
) -> CodedPlate:
    """The code that was asked for, or the one that follows from the position or from an allocated registry number.

    Parameters
    ----------
    wanted : CodeInput
    n : int
        Units along a side.
    place_deg : (float, float) or None
        Longitude and latitude; None where the plate has no position yet. [deg]
    allocate : callable
        Allocates a registry number if the request has none.

    Raises
    ------
    InvalidParameter, CodeMismatch
        The code contradicts itself or the position, or it follows from a position that is not known.
    """
    if wanted.scheme is not PlateScheme.ID and wanted.digits is None and place_deg is None:
        raise InvalidParameter(
            f"the digits of the scheme {wanted.scheme} follow from the position, and there is none",
            field="position",
            limit="a position, or the digits",
            cure="send the position of the plate's centre",
        )
    with naming("code"):
        _check_code_request(wanted)
        if wanted.scheme is PlateScheme.ID:
            return _numbered(wanted, n, allocate)
        if place_deg is None:
            return CodedPlate(PlateCode(wanted.digits or "", wanted.scheme, n, wanted.check_digits or 1), None, True)
        return _at_position(wanted, n, place_deg)


def _numbered(wanted: CodeInput, n: int, allocate: Callable[[], PlateCode]) -> CodedPlate:
    if wanted.digits is not None:
        return CodedPlate(PlateCode(wanted.digits, PlateScheme.ID, n), None, True)
    if wanted.registry_number is not None:
        return CodedPlate(PlateCode.from_registry_number(wanted.registry_number, n=n), None, True)
    return CodedPlate(allocate(), None, False)


def _at_position(wanted: CodeInput, n: int, place_deg: tuple[float, float]) -> CodedPlate:
    expected = position_code(*place_deg, n, wanted.scheme, wanted.check_digits)
    if wanted.digits is None:
        return CodedPlate(expected, True, False)
    code = PlateCode(wanted.digits, wanted.scheme, n, wanted.check_digits or 1)
    matches = code == expected
    if not matches and not wanted.allow_mismatched_digits:
        lon_deg, lat_deg = place_deg
        raise CodeMismatch(
            f"the digits {code.digits} do not fit the position {lon_deg:.6f}, {lat_deg:.6f}, "
            f"whose digits are {expected.digits}",
            field="code.digits",
            limit=f"{expected.digits} at {lon_deg:.6f}, {lat_deg:.6f} deg",
            cure="leave the digits out, correct the position, or set code.allow_mismatched_digits for a test plate",
        )
    return CodedPlate(code, matches, not matches)


def position_code(lon_deg: float, lat_deg: float, n: int, scheme: PlateScheme, check_digits: int | None) -> PlateCode:
    """The code of a plate at a position."""
    return PlateCode.from_position(lon_deg, lat_deg, n=n, scheme=scheme, check_digits=check_digits or 0)


def _check_code_request(wanted: CodeInput) -> None:
    is_id = wanted.scheme is PlateScheme.ID
    for name, misplaced in (
        ("registry_number", not is_id and wanted.registry_number is not None),
        ("check_digits", wanted.scheme is not PlateScheme.POSITION_CHECK and wanted.check_digits is not None),
        ("allow_mismatched_digits", is_id and wanted.allow_mismatched_digits),
    ):
        if misplaced:
            raise InvalidParameter(
                f"{name} means nothing in the scheme {wanted.scheme}",
                field=f"code.{name}",
                limit="registry_number: id; check_digits: position-check; allow_mismatched_digits: position schemes",
                cure=f"leave {name} out or choose the scheme it belongs to",
            )
    if wanted.digits is not None and wanted.registry_number is not None:
        raise InvalidParameter(
            "give the digits or the registry number, not both",
            field="code.registry_number",
            limit="one of digits, registry_number",
            cure="leave one of the two out",
        )
