"""Commands that plan a road without a server, from a file with lanes to a folder with all outputs, and check rules."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, cast

import typer

from app.cli.terminal import bad_input
from app.errors import InvalidParameter
from app.geodesy.systems import normalize_vertical_datum

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    import numpy.typing as npt
    from rich.console import Console

    from app.formats.surveys.declaration import Unit
    from app.markers.plate import PlateGeometry
    from app.markers.reading import PlateReading
    from app.planning.outputs.package import PackageOptions
    from app.planning.plan import Plan


RoadArgument = Annotated[
    Path, typer.Argument(exists=True, dir_okay=False, help="GeoJSON, GeoPackage, Shapefile, LandXML, DXF, ...")
]
RulesOption = Annotated[Path, typer.Option(exists=True, dir_okay=False, help="Rules as YAML or JSON.")]
OutOption = Annotated[Path, typer.Option(help="Folder for the files; created if it does not exist.")]
OriginOption = Annotated[
    str | None, typer.Option(help="LON,LAT of the origin of local coordinates; markers are then not surveyed. [deg]")
]
_PLAN_FILE = "plan.json"


def plan(
    road: RoadArgument,
    rules: RulesOption,
    out: OutOption,
    origin: OriginOption = None,
    bearing: Annotated[float, typer.Option(help="Direction of the local y axis, with --origin. [deg]")] = 0.0,
    crs: Annotated[str | None, typer.Option(help="CRS of the road's coordinates, e.g. EPSG:25832.")] = None,
    realization: Annotated[str | None, typer.Option(help="Frame of the coordinates, e.g. ITRF2014.")] = None,
    epoch: Annotated[float | None, typer.Option(help="Coordinate epoch. [decimal year]")] = None,
    vertical_datum: Annotated[str | None, typer.Option(help="ellipsoid, or the datum, e.g. EPSG:5703.")] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of the road's coordinates: m, ft-us or ft-intl.")] = None,
    ignore_heights: Annotated[bool, typer.Option("--ignore-heights", help="Leave heights out.")] = False,
    name: Annotated[str | None, typer.Option(help="Name of the plan. Default: that of the road's file.")] = None,
    stakeout_crs: Annotated[
        str | None, typer.Option(help="Projected CRS of the stakeout. Default: the road's.")
    ] = None,
    stakeout_unit: Annotated[str | None, typer.Option(help="Unit of the stakeout: m, ft-us or ft-intl.")] = None,
    scale: Annotated[int | None, typer.Option(help="Scale of the drawings: 250, 500, 1000, 2000 or 5000.")] = None,
    owner: Annotated[str, typer.Option(help="Legal owner, for the title block.")] = "",
    number: Annotated[str, typer.Option(help="Identification number, for the title block.")] = "",
    date: Annotated[str, typer.Option(help="Date of issue, for the title block.")] = "",
    creator: Annotated[str, typer.Option(help="Creator, for the title block.")] = "",
    approver: Annotated[str, typer.Option(help="Approval person, for the title block.")] = "",
    artwork: Annotated[
        bool, typer.Option("--artwork", help="Also write drilling sheets and artwork, and manifest.json with SHA-256.")
    ] = False,
) -> None:
    """Place markers on a road by rules, check them, and write bill, drawings, stakeout and schedule.

    The exit status is 2 if the road or the rules are refused; then nothing is written.
    """
    from rich.console import Console

    from app.formats.alignments.geometry import AlignmentDeclaration
    from app.planning.outputs.drawing_sheet import TitleBlock
    from app.planning.outputs.package import PackageOptions

    console = Console(stderr=True)
    with bad_input():
        _check_folder(out)
        declaration = AlignmentDeclaration(
            crs,
            realization,
            epoch,
            vertical_datum and normalize_vertical_datum(vertical_datum),
            cast("Unit | None", unit),
            None,
            ignore_heights,
            _origin(origin),
            bearing,
        )
        made = _make(console, road, rules, declaration, name or road.stem)
        options = PackageOptions(
            stakeout_crs,
            cast("Unit | None", stakeout_unit),
            scale=scale,
            title_block=TitleBlock(owner, number, date, creator, approver),
        )
        _write(console, made, out, options, artwork=artwork)
    _print(made, out)


def _origin(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        lon, lat = (float(part) for part in text.split(","))
    except ValueError:
        raise InvalidParameter(
            f"--origin is {text[:60]!r}", field="origin", limit="LON,LAT in degrees", cure="write e.g. 8.42,49.01"
        ) from None
    return lon, lat


def _check_folder(out: Path) -> None:
    """A folder that is new, empty, or has a plan already, whose files are replaced."""
    if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not (out / _PLAN_FILE).exists())):
        raise InvalidParameter(
            f"{out} has files that are no plan",
            field="out",
            limit="a new or empty folder, or one with a plan",
            cure="choose another folder",
        )


def _make(console: Console, road: Path, rules_file: Path, declaration: object, name: str) -> Plan:
    """Read, place and check, each with its line of progress."""
    from app.formats.alignments.geometry import AlignmentDeclaration
    from app.formats.alignments.read import read_alignment
    from app.planning.build_alignment import build_alignment
    from app.planning.planner import make_plan
    from app.planning.rules import read_rules

    assert isinstance(declaration, AlignmentDeclaration)
    with console.status("Reading the rules") as status:
        rules = read_rules(rules_file.read_bytes())
        status.update("Reading the road")
        file = read_alignment(road.read_bytes(), road.name, declaration=declaration)
        status.update("Placing the road")
        alignment = build_alignment(file, rules.road, declaration, name=road.stem)
        made = make_plan(alignment, rules, name=name, report=status.update)
    if not made.markers:
        raise InvalidParameter(
            "the rules place no marker on this road",
            field="rules",
            limit="at least one marker",
            cure="; ".join(left.reason for left in made.left_out[:3]) or "check lanes, spacing and line styles",
        )
    return made


def _write(console: Console, made: Plan, out: Path, options: PackageOptions, *, artwork: bool) -> None:
    """All files, or none: they are moved into the folder when the last one is complete."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from app.encoders.packer import file_entry
    from app.planning.outputs.package import MANIFEST, Package, PartKind
    from app.plots.track import draw_trade_off

    package = Package(made, options, draw_trade_off)
    out.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=out.parent, prefix=".waymark-") as folder:
        parts = [part for part in package.parts() if artwork or part.kind is PartKind.FILE]
        entries = []
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as progress:
            task = progress.add_task("Writing", total=len(parts))
            for part in parts:
                progress.update(task, description=f"Writing {part.name or part.kind}")
                for name, content in package.write(part, _read_face):
                    _put(Path(folder) / name, content)
                    entries.append(file_entry(name, content))
                progress.advance(task)
        if artwork:
            _put(Path(folder) / MANIFEST, package.manifest(entries))
        names: list[str] = [entry["name"] for entry in entries]
        for name in [*names, MANIFEST] if artwork else names:
            target = out / name
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(Path(folder) / name, target)


def _read_face(image: npt.NDArray[np.uint8], geometry: PlateGeometry) -> Sequence[PlateReading]:
    """The plate decoder, imported with the first plate: it takes seconds."""
    from app.services.plans.tasks import read_face

    return read_face(image, geometry)


def _put(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def _print(made: Plan, out: Path) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from app.markers.reading import Verdict
    from app.planning.outputs.bill import (
        counts_sentence,
        finding_figures,
        finding_place,
        optimum_sentence,
        plan_bill,
        verdict_counts,
    )

    console = Console()
    road = made.alignment
    console.print(f"[bold]{escape(made.name)}[/]: {len(road.lanes)} lanes, {road.lane_length_m / 1000:.3f} km of lane")
    console.print(f"  {counts_sentence(made)}")
    console.print(f"  cost: {escape(plan_bill(made).sentence)}")
    if made.optimum is not None:
        console.print(f"  {escape(optimum_sentence(made.optimum, made.rules.costs.currency))}")
    if not road.surveyed:
        console.print("  [yellow]PLANNED - positions not surveyed[/]: the road was placed by an origin")
    for warning in road.warnings[:5]:
        console.print(f"  [yellow]warning[/]: {escape(warning)}")
    colours = {Verdict.OK: "green", Verdict.WARN: "yellow", Verdict.FAIL: "red"}
    table = Table("check", "verdict", "figure", "limit", "where")
    for finding in made.findings:
        colour = colours[finding.verdict]
        figure, limit = finding_figures(finding)
        verdict = f"[{colour}]{finding.verdict.value}[/]"
        table.add_row(escape(finding.name), verdict, figure, limit, escape(finding_place(finding)))
    if made.findings:
        console.print(table)
        for finding in made.findings:
            if finding.verdict is not Verdict.OK:
                colour = colours[finding.verdict]
                console.print(
                    f"  [{colour}]{finding.verdict.value}[/] {escape(finding.name)}: {escape(finding.sentence)}"
                )
        found = verdict_counts(made)
        console.print("  checks: " + ", ".join(f"{count} {verdict.value}" for verdict, count in found.items()))
    removed = sum(left.moved_m is None for left in made.left_out)
    if made.left_out:
        console.print(f"  {removed} places left out, {len(made.left_out) - removed} markers moved; see report.md")
    console.print(f"  files: {escape(str(out))}")


# === Commands for the rules of plans.


_HELP = "The rules of plans: their JSON Schema, and a check of a document."
rules_cli = typer.Typer(no_args_is_help=True, help=_HELP)


@rules_cli.callback(help=_HELP)
def rules() -> None:
    """Group the commands `waymark rules ...`."""


@rules_cli.command()
def schema() -> None:
    """Print the JSON Schema (draft 2020-12) of the rules."""
    import orjson

    from app.planning.rules import rules_schema

    typer.echo(orjson.dumps(rules_schema(), option=orjson.OPT_INDENT_2))


@rules_cli.command()
def check(
    file: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="Rules as YAML or JSON.")],
) -> None:
    """Read rules and print them with their defaults as JSON. The exit status is 2 if they are refused."""
    from app.cli.terminal import bad_input
    from app.planning.rules import read_rules

    with bad_input():
        read = read_rules(file.read_bytes())
    typer.echo(read.model_dump_json(indent=2, by_alias=True))
