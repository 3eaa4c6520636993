"""What a fabricator is asked to make."""

from __future__ import annotations

from dataclasses import dataclass, field

from app.errors import CodeMismatch, InvalidParameter
from app.geodesy import check_lon_lat
from app.markers.plate import PlateCode, PlateGeometry

MAX_ID_LENGTH = 64
MAX_NOTE_LENGTH = 80
MAX_URL_LENGTH = 150


@dataclass(frozen=True, slots=True)
class PlateOrder:
    """One plate to make.

    Parameters
    ----------
    plate_id : str
        The registry's name for it, 1 to 64 characters.
    code : PlateCode
    geometry : PlateGeometry
        Its ``n`` is the code's.
    record_url : str
        Address of the marker's public page, for the QR code on the margin; printable ASCII, at most 150 characters.
        Empty: there is no QR code, and the margin states that.
    revision : int
        Revision of the record that the artwork shows, >= 1.
    lon_deg, lat_deg : float, optional
        Surveyed or planned position. [deg]
    crs : str
        Its coordinate reference system, realization and epoch, for the margin, at most 80 characters.
    registered : bool
        Whether the plate is in the registry; a draft is not, and the margin gives that as the reason for no QR code.

    Raises
    ------
    InvalidParameter
        A value is outside these limits, or the code is for another size of plate.
    """

    plate_id: str
    code: PlateCode
    geometry: PlateGeometry = field(default_factory=PlateGeometry)
    record_url: str = ""
    revision: int = 1
    lon_deg: float | None = None
    lat_deg: float | None = None
    crs: str = ""
    registered: bool = True

    def __post_init__(self) -> None:
        if self.code.n != self.geometry.n:
            raise InvalidParameter(
                f"the code is for {self.code.n} x {self.code.n} units, the geometry has {self.geometry.n}",
                field="geometry.n",
                limit=f"{self.code.n}",
                cure="give the code and the plate the same number of units along a side",
            )
        if not self.code.units.any():
            raise CodeMismatch(
                f"the face of {self.code.digits} is blank: no unit is dark, a bare plate looks the same",
                field="digits",
                limit="at least one dark unit",
                cure="move the plate by a micro-degree, add check digits, or use the scheme id with another number",
            )
        _check_text("plate_id", self.plate_id, 1, MAX_ID_LENGTH)
        _check_text("crs", self.crs, 0, MAX_NOTE_LENGTH)
        _check_text("record_url", self.record_url, 0, MAX_URL_LENGTH)
        if not self.record_url.isascii():
            raise InvalidParameter(
                "record_url has characters outside ASCII",
                field="record_url",
                limit="printable ASCII",
                cure="percent-encode the address",
            )
        if self.revision < 1:
            raise InvalidParameter(f"revision is {self.revision}", field="revision", limit="1 or more")
        if (self.lon_deg is None) != (self.lat_deg is None):
            raise InvalidParameter("a position has a longitude and a latitude", field="position", limit="both or none")
        if self.lon_deg is not None and self.lat_deg is not None:
            check_lon_lat(self.lon_deg, self.lat_deg)

    @property
    def grouped_digits(self) -> str:
        """The code for people: longitude and latitude apart, or groups of four."""
        digits = self.code.digits
        size = 6 if self.code.n == 8 and not self.code.scheme.corrects else 4
        return " ".join(digits[i : i + size] for i in range(0, len(digits), size))


def _check_text(name: str, text: str, shortest: int, longest: int) -> None:
    if not shortest <= len(text) <= longest or not text.isprintable() or text != text.strip():
        raise InvalidParameter(
            f"{name} has {len(text)} characters, or some that cannot be printed",
            field=name,
            limit=f"{shortest} to {longest} printable characters without spaces at the ends",
        )


def reference_text(realization: str | None, epoch: float | None, warning: str | None = None) -> str:
    """Reference system for the margin: frame and epoch of the position, and a warning if it is only approximate."""
    text = " ".join(str(realization or "WGS 84").split()) + (f" @ {epoch:.2f}" if epoch is not None else "")
    if warning is not None:
        text = f"{text[: MAX_NOTE_LENGTH - len(warning) - 3]} ({warning})"
    return "".join(c if c.isprintable() and c.isascii() else "?" for c in text)[:MAX_NOTE_LENGTH].strip()


@dataclass(frozen=True, slots=True)
class ArtworkOptions:
    """What else a drawing shows.

    Parameters
    ----------
    heaters : bool
        Heating tracks under dark units and markers, on the layer HEATER.
    leds : bool
        Light sources under light units and markers, on the layer LED.
    """

    heaters: bool = False
    leds: bool = False
