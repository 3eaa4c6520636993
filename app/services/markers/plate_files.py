"""Plates without the registry: a code to artwork, a picture to readings. The caller reads and writes the files."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from app.encoders.plate import ArtworkFormat, ArtworkOptions, PlateOrder, PlateReader, prove_plate, write_artwork
from app.encoders.plate import encode_plate as draw_plate
from app.errors import InvalidParameter
from app.families.plate.plates import GeometryIn
from app.formats.images import ImageLimits, load_image
from app.markers.plate import RECOMMENDED_POSITION_SCHEME, PlateCode, PlateGeometry, PlateScheme, recommended_geometry
from app.markers.reading import PlateReading
from app.services.decodes.frame_documents import FramesResult, ReadFrame, ReadMarker, frames_result


def plate_for(
    position: tuple[float, float] | None,
    registry_number: int | None,
    size: GeometryIn,
    *,
    scheme: str = RECOMMENDED_POSITION_SCHEME,
    check_digits: int | None = None,
) -> tuple[PlateCode, PlateGeometry]:
    """Code and dimensions of a plate that is asked for by position or by registry number.

    Parameters
    ----------
    position : (float, float) or None
        Longitude, latitude. [deg]
    scheme : str
        Of positions.
    check_digits : int, optional
        Of the scheme ``position-check``: 1 or 2.

    Raises
    ------
    InvalidParameter
        Both position and number are given, or none; the scheme is none of positions, or has no check digits.
    """
    if (position is None) == (registry_number is None):
        raise InvalidParameter(
            "a plate carries a position or a registry number",
            limit="one of the two",
            cure="give --lon-deg and --lat-deg, or --registry-number",
        )
    of_positions = [str(one) for one in PlateScheme if one is not PlateScheme.ID]
    if scheme not in of_positions:
        raise InvalidParameter(
            f"positions have no scheme {scheme}",
            field="scheme",
            limit=", ".join(of_positions),
            cure="choose one of them",
        )
    if check_digits is not None and scheme != PlateScheme.POSITION_CHECK:
        raise InvalidParameter(
            f"the scheme {scheme} has no check digits",
            field="check_digits",
            limit=PlateScheme.POSITION_CHECK,
            cure=f"choose the scheme {PlateScheme.POSITION_CHECK}, or leave the check digits out",
        )
    wanted = PlateScheme(scheme) if position is not None else PlateScheme.ID
    geometry = recommended_geometry(wanted, **size.model_dump())
    if position is not None:
        code = PlateCode.from_position(*position, n=geometry.n, scheme=wanted, check_digits=check_digits or 0)
        return code, geometry
    assert registry_number is not None
    return PlateCode.from_registry_number(registry_number, n=geometry.n), geometry


def encode_plate_files(
    code: PlateCode,
    geometry: PlateGeometry,
    formats: Sequence[ArtworkFormat],
    *,
    position: tuple[float, float] | None,
    read: PlateReader,
    options: ArtworkOptions | None = None,
) -> dict[str, bytes]:
    """Artwork of a plate by file name, proved by reading it back first.

    Raises
    ------
    ProofFailed
        The drawing did not read back as its own code.
    """
    lon_deg, lat_deg = position if position is not None else (None, None)
    order = PlateOrder(
        plate_id=code.digits,
        code=code,
        geometry=geometry,
        lon_deg=lon_deg,
        lat_deg=lat_deg,
        crs="WGS 84" if position is not None else "",
    )
    drawing = draw_plate(order, options or ArtworkOptions())
    prove_plate(drawing, code, geometry, read)
    return {f"{code.digits}.{form}": write_artwork(drawing, form).content for form in formats}


def decode_picture(
    name: str,
    data: bytes,
    *,
    decode: Callable[..., list[PlateReading]],
    limits: ImageLimits,
    thermal: bool = False,
    codebook: Sequence[PlateCode] = (),
) -> FramesResult:
    """Readings of one picture, in the form that the API returns.

    Raises
    ------
    UnreadableUpload
        The picture is damaged, too large, or of an unknown kind.
    """
    started = time.perf_counter()
    frame = load_image(data, limits, thermal=thermal)
    loaded = time.perf_counter()
    readings = decode(frame.pixels, thermal=thermal, codebook=tuple(codebook))
    read = ReadFrame(
        index=0,
        name=name,
        header=frame.header,
        markers=tuple(ReadMarker(reading) for reading in readings),
        load_ms=(loaded - started) * 1000,
        decode_ms=(time.perf_counter() - loaded) * 1000,
    )
    return frames_result([read], codebook_plates=len(codebook))
