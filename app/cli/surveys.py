"""Commands that import surveys and export markers, for files of any size."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeVar

import typer
from pydantic import BaseModel, ValidationError

from app.cli.database import perform, read_settings
from app.cli.terminal import JsonOption
from app.errors import InvalidParameter

# === Declarations that commands get as JSON: the same schemas as over HTTP.


Model = TypeVar("Model", bound=BaseModel)


def read_declaration(schema: type[Model], declared: str, guide: str) -> Model:
    """A declaration checked by its schema.

    Parameters
    ----------
    declared : str
        JSON.
    guide : str
        Document that explains the declaration.

    Raises
    ------
    InvalidParameter
        It is not JSON, or not as the schema has it.
    """
    try:
        return schema.model_validate_json(declared)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise InvalidParameter(f"--declaration {place}: {first['msg']}", cure=f"see {guide}") from error


# === Commands that import surveys and export markers, for files of any size.


def import_survey(
    survey: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="CSV, GeoJSON, GeoPackage, ...")],
    agency: Annotated[str, typer.Option(help="Name of the agency that owns the markers.")],
    declared: Annotated[str, typer.Option("--declaration", help="Declaration as JSON; see docs/imports.md.")] = "{}",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Report only; nothing is stored.")] = False,
    map_file: Annotated[Path | None, typer.Option("--map", help="SVG file for the residuals of a comparison.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Import a survey and print the report as JSON, also while the server runs. The exit status is 1 if refused."""
    import orjson

    from app.services.surveys.import_report import DeclarationIn

    declaration = read_declaration(DeclarationIn, declared, "docs/imports.md")
    declaration = declaration.model_copy(update={"dry_run": dry_run or declaration.dry_run})
    values = {"agency": agency, "declaration": declaration.model_dump(mode="json")}
    with survey.open("rb") as file:
        report = perform(read_settings(), "import", values, (file.fileno(),), quiet=as_json)["report"]
    shown: dict[str, object] = {**report}
    if map_file is not None and report["comparison"] is not None:
        map_file.write_text(report["comparison"]["map_svg"] or "")
        shown["comparison"] = {name: value for name, value in report["comparison"].items() if name != "map_svg"}
    typer.echo(orjson.dumps(shown, option=orjson.OPT_INDENT_2))
    if report["outcome"] == "refused":
        raise typer.Exit(1)


def export_markers(
    out: Annotated[Path, typer.Argument(dir_okay=False, help="File to write; it must not exist.")],
    agency: Annotated[str, typer.Option(help="Name of the agency that owns the markers.")],
    kind: Annotated[
        str,
        typer.Option("--format", help="csv, geojson, gpkg, geoparquet, flatgeobuf, shapefile, kml, landxml or dxf."),
    ] = "gpkg",
    bbox: Annotated[str | None, typer.Option(help="Only markers in west,south,east,north. [deg]")] = None,
    status: Annotated[str | None, typer.Option(help="Only markers with this status.")] = None,
    family: Annotated[
        str | None, typer.Option(help="Only markers of this family: plate, magnet, cerpm or fiducial.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write an agency's markers to a file, also while the server runs."""
    from tempfile import TemporaryDirectory

    import orjson

    from app.families import FAMILY_NAMES
    from app.markers.reading import STATUSES
    from app.services.surveys.exports import KINDS

    for name, given, allowed in (
        ("format", kind, KINDS),
        ("status", status, STATUSES),
        ("family", family, FAMILY_NAMES),
    ):
        if given is not None and given not in allowed:
            raise InvalidParameter(f"there is no {name} {given[:40]!r}", field=f"--{name}", limit=", ".join(allowed))
    if out.exists():
        raise InvalidParameter(f"{out} already exists", cure="remove it, or choose another name")
    values = {"agency": agency, "kind": kind, "bbox": bbox, "status": status, "family": family}
    with TemporaryDirectory(dir=out.parent, prefix=".waymark-") as folder:
        written = Path(folder, out.name)
        with written.open("xb") as file:
            left_out = perform(read_settings(), "export", values, (file.fileno(),), quiet=as_json)["left_out"]
        written.rename(out)
    if as_json:
        typer.echo(orjson.dumps({"file": str(out), "left_out": left_out}, option=orjson.OPT_INDENT_2))
        return
    if left_out:
        typer.echo(f"left out, outside the area of the file's reference system: {' '.join(left_out)}", err=True)
    typer.echo(out)
