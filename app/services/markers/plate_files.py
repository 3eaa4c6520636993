"""Plates without the registry: a code to artwork, a picture to readings. The caller reads and writes the files."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from app.encoders.plate import ArtworkFormat, ArtworkOptions, PlateOrder, PlateReader, prove_plate, write_artwork
from app.encoders.plate import encode_plate as draw_plate
from app.errors import InvalidParameter
from app.formats.images import ImageLimits, load_image
from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import PlateReading
from app.services.decodes.frame_documents import FramesResult, ReadFrame, ReadMarker, frames_result


def plate_code_for(
    position: tuple[float, float] | None, registry_number: int | None, *, n: int, check_digits: int = 0
) -> PlateCode:
    """The code of a plate that is asked for by position or by registry number.

    Parameters
    ----------
    position : (float, float) or None
        Longitude, latitude. [deg]
    registry_number : int or None
    n : int
        Units along a side.
    check_digits : int
        For positions: 0, 1 or 2.

    Raises
    ------
    InvalidParameter
        Both are given, or none.
    """
    if position is not None and registry_number is None:
        return PlateCode.from_position(*position, n=n, check_digits=check_digits)
    if registry_number is not None and position is None:
        return PlateCode.from_registry_number(registry_number, n=n)
    raise InvalidParameter(
        "a plate carries a position or a registry number",
        limit="one of the two",
        cure="give --lon-deg and --lat-deg, or --registry-number",
    )


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
