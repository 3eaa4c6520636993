"""Commands that need no server: artwork, calibration boards, decoding of pictures and traces, print grades."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.database import read_settings
from app.cli.surveys import read_declaration
from app.errors import InvalidParameter

if TYPE_CHECKING:
    from app.encoders.plate import ArtworkFormat


OutOption = Annotated[Path, typer.Option(help="Folder for the files; created if it does not exist.")]
FormatOption = Annotated[list[str] | None, typer.Option("--format", help="svg, pdf, dxf or png; may be repeated.")]


def encode(
    out: OutOption = Path("."),
    lon_deg: Annotated[float | None, typer.Option(help="Longitude of a position plate. [deg]")] = None,
    lat_deg: Annotated[float | None, typer.Option(help="Latitude of a position plate. [deg]")] = None,
    scheme: Annotated[
        str, typer.Option(help="Of a position plate: position-robust, position-check or position.")
    ] = "position-robust",
    check_digits: Annotated[
        int | None, typer.Option(min=1, max=2, help="Check digits of a position-check plate, 1 by default.")
    ] = None,
    registry_number: Annotated[int | None, typer.Option(help="Registry number of an id plate.")] = None,
    n: Annotated[
        int | None, typer.Option(help="Units along a side: 8, 10 or 12; by default 10 for position-robust, else 8.")
    ] = None,
    unit_mm: Annotated[
        float | None, typer.Option(help="Side of a unit; by default 27 for position-robust, else 35. [mm]")
    ] = None,
    gap_mm: Annotated[float, typer.Option(help="Gap between units. [mm]")] = 5.0,
    thickness_mm: Annotated[float, typer.Option(help="Thickness of the base plate. [mm]")] = 20.0,
    form: FormatOption = None,
) -> None:
    """Write the artwork of one plate at true size, after the decoder has read it back."""
    from app.decoders.plate.reader import decode_plates
    from app.families.plate.plates import GeometryIn
    from app.services.markers.plate_files import encode_plate_files, plate_for

    formats = _formats(form or ("svg", "pdf"))
    position = (lon_deg, lat_deg) if lon_deg is not None and lat_deg is not None else None
    size = GeometryIn(n=n, unit_mm=unit_mm, gap_mm=gap_mm, thickness_mm=thickness_mm)
    code, geometry = plate_for(position, registry_number, size, scheme=scheme, check_digits=check_digits)
    files = encode_plate_files(
        code,
        geometry,
        formats,
        position=position,
        read=lambda image, geometry: decode_plates(image, geometries=(geometry,)),
    )
    out.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (out / name).write_bytes(content)
        typer.echo(out / name)


def board(
    out: OutOption = Path("."),
    columns: Annotated[int, typer.Option(help="Columns of squares.")] = 7,
    rows: Annotated[int, typer.Option(help="Rows of squares.")] = 10,
    square_mm: Annotated[float, typer.Option(help="Side of a square. [mm]")] = 25.0,
    marker_mm: Annotated[float, typer.Option(help="Side of a marker. [mm]")] = 18.0,
    form: FormatOption = None,
) -> None:
    """Write a board for calibrating cameras, at true size; print it at 100 %."""
    from app.encoders.calibration_board import encode_board
    from app.encoders.plate import write_artwork
    from app.sensors.camera import CalibrationBoard

    formats = _formats(form or ("pdf",))
    drawing = encode_board(CalibrationBoard(columns, rows, square_mm, marker_mm))
    out.mkdir(parents=True, exist_ok=True)
    for name in formats:
        path = out / f"waymark-board-{columns}x{rows}-{square_mm:g}mm.{name}"
        path.write_bytes(write_artwork(drawing, name).content)
        typer.echo(path)


def decode(
    pictures: Annotated[list[Path], typer.Argument(exists=True, dir_okay=False, help="JPEG or PNG files.")],
    thermal: Annotated[bool, typer.Option(help="The pictures come from a thermal camera.")] = False,
) -> None:
    """Decode the plates in pictures, and print one JSON object for each picture."""
    import orjson

    from app.decoders.plate.reader import decode_plates
    from app.formats.images import ImageLimits
    from app.services.markers.plate_files import decode_picture

    limits = ImageLimits(pixels=read_settings().max_image_pixels)
    for picture in pictures:
        found = decode_picture(picture.name, picture.read_bytes(), decode=decode_plates, limits=limits, thermal=thermal)
        typer.echo(orjson.dumps(found, option=orjson.OPT_SERIALIZE_NUMPY))


def grade_print(
    photo: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="JPEG or PNG of one printed plate.")],
    digits: Annotated[str | None, typer.Option(help="What the plate should be; without it, what is read.")] = None,
    scheme: Annotated[str, typer.Option(help="id, position-robust, position-check or position.")] = "id",
    n: Annotated[int | None, typer.Option(help="Units along a side; that of the scheme if left out.")] = None,
    unit_mm: Annotated[float | None, typer.Option(help="Side of a unit. [mm]")] = None,
    gap_mm: Annotated[float, typer.Option(help="Gap between units. [mm]")] = 5.0,
    speed_kmh: Annotated[float, typer.Option(min=5.0, max=250.0, help="Design speed. [km/h]")] = 60.0,
    pdf: Annotated[Path | None, typer.Option(help="Also write the page to this file.")] = None,
) -> None:
    """Grade a printed plate by a photo, and print the grade as JSON."""
    import orjson

    from app.formats.format import SpooledFile
    from app.formats.images import ImageLimits
    from app.markers.plate import PlateCode, PlateScheme, recommended_geometry
    from app.planning.rules import CameraRules
    from app.services.markers.tasks import PrintedPlate, grade_photo

    if scheme not in list(PlateScheme):
        raise InvalidParameter(f"there is no scheme {scheme}", limit=", ".join(PlateScheme))
    geometry = recommended_geometry(PlateScheme(scheme), n=n, unit_mm=unit_mm, gap_mm=gap_mm)
    code = None if digits is None else PlateCode(digits, PlateScheme(scheme), geometry.n)
    graded = grade_photo(
        SpooledFile.of(photo.read_bytes()),
        datetime.now(UTC),
        PrintedPlate(code, geometry),
        CameraRules(),
        speed_kmh,
        as_pdf=pdf is not None,
        limits=ImageLimits(pixels=read_settings().max_image_pixels),
    )
    if pdf is not None:
        pdf.write_bytes(graded.pdf)
    typer.echo(orjson.dumps(graded.document))


def _formats(names: list[str] | tuple[str, ...]) -> list[ArtworkFormat]:
    from app.encoders.plate import ArtworkFormat

    unknown = sorted(set(names) - set(ArtworkFormat))
    if unknown:
        raise InvalidParameter(f"there is no format {unknown[0]}", limit=", ".join(ArtworkFormat))
    return [ArtworkFormat(name) for name in names]


# === The command that decodes a magnetometer trace without a server.


def decode_trace(
    recording: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="A file, or a ZIP of one recording.")],
    declared: Annotated[str, typer.Option("--declaration", help="Declaration as JSON; see docs/magnets.md.")] = "{}",
    plot: Annotated[Path | None, typer.Option(help="SVG file for the plot.")] = None,
) -> None:
    """Decode the magnets and tags in a magnetometer trace, and print one JSON object."""
    import orjson

    from app.decoders.magnet.identify import match_tags
    from app.decoding.declarations import DeclaredTrace
    from app.formats.format import SpooledFile
    from app.services.decodes.trace_documents import trace_result
    from app.services.decodes.trace_tasks import decode_recording

    terms = read_declaration(DeclaredTrace, declared, "docs/magnets.md")
    result = decode_recording(recording.name, SpooledFile.at(recording), terms)
    trace = match_tags(result.findings, (), terms.sensors)
    if plot is not None:
        plot.write_bytes(result.plot)
    document = trace_result(result, trace, codebook_tags=0)
    typer.echo(orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY))
