"""The command that proves a plan without a server: simulated drives over the plan of a folder."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.terminal import bad_input
from app.errors import InvalidParameter

if TYPE_CHECKING:
    from app.planning.proof import ProofReport, ProofTerms

_PLAN_FILE, _RESULTS_FILE = "plan.json", "proof-units.jsonl"
_SHOWN_WEAK = 20  # rows of the table of weak markers; a screen
FolderArgument = Annotated[Path, typer.Argument(exists=True, file_okay=False, help="Folder that `waymark plan` wrote.")]


def proof(
    folder: FolderArgument,
    drives: Annotated[int, typer.Option(help="Simulated drives.")] = 6,
    seed: Annotated[int, typer.Option(help="The same seed gives the same result.")] = 1,
    conditions: Annotated[
        str, typer.Option(help="Conditions in turn: day, night, rain, shade, wear, dirt, or joined as night+rain.")
    ] = "day",
    lost: Annotated[float, typer.Option(help="Share of the markers that are missing in a drive.")] = 0.0,
    speed: Annotated[float, typer.Option(help="Speed as a share of the design speed.")] = 1.0,
    max_markers: Annotated[
        int | None, typer.Option(help="Plates and tags each that a drive passes; more are sampled.")
    ] = None,
    max_sections: Annotated[
        int | None, typer.Option(help="Stretches of line magnets and of CERPMs each in a drive.")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes. Default: one a core.")] = None,
) -> None:
    """Drive over the plan of a folder in simulation, and write proof.json and proof.csv beside it.

    An interrupted proof goes on where it was when the same command is run again. The exit status is 2 if the folder has
    no plan or an option is refused.
    """
    import orjson
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as ProgressBar

    from app.cli.proof_runner import run_proof
    from app.planning.proof.report import markers_csv

    options = {
        "drives": drives, "seed": seed, "lost_share": lost, "speed_share": speed,
        "conditions": [part.strip() for part in conditions.split(",")],
        "max_markers_per_drive": max_markers, "max_sections_per_drive": max_sections,
    }  # fmt: skip
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with bad_input():
        terms = _terms({name: value for name, value in options.items() if value is not None})
        if not (folder / _PLAN_FILE).is_file():
            raise InvalidParameter(
                f"{folder} has no {_PLAN_FILE}",
                field="folder",
                limit="a folder with a plan",
                cure="make the plan with waymark plan ROAD --rules RULES --out FOLDER",
            )
        with ProgressBar(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("Driving", total=None)
            report = run_proof(
                folder / _PLAN_FILE,
                terms,
                folder / _RESULTS_FILE,
                workers or os.cpu_count() or 1,
                lambda done, total: bar.update(task, completed=done, total=total),
            )
    (folder / "proof.json").write_bytes(report.write(orjson.OPT_INDENT_2))
    (folder / "proof.csv").write_text(markers_csv(report))
    _print(report, folder)


def _terms(options: dict[str, object]) -> ProofTerms:
    from pydantic import ValidationError

    from app.planning.proof import ProofTerms

    try:
        return ProofTerms.model_validate(options)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = str(first["loc"][0])
        limit = "day, night, rain, shade, wear, dirt" if field == "conditions" else first["msg"]
        raise InvalidParameter(
            f"{field} is {str(first['input'])[:60]}: {first['msg']}",
            field=field,
            limit=limit,
            cure="waymark proof --help",
        ) from None


def _print(report: ProofReport, folder: Path) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console()
    console.print(f"[bold]{escape(report.plan)}[/]: {report.terms.drives} simulated drives, seed {report.terms.seed}")
    rates = Table("read", "condition", "passes", "missing", "read rate", "95 % interval")
    for rate in report.rates:
        interval = f"{100 * rate.low:.1f} to {100 * rate.high:.1f} %"
        rates.add_row(rate.kind, rate.condition, str(rate.passes), str(rate.lost), f"{100 * rate.rate:.1f} %", interval)
    if report.rates:
        console.print(rates)
    drives = Table("drive", "lane", "condition", "fixes", "fix RMS", "longest gap", "path RMS", "path worst", "wrong")
    for drive in report.drives:
        gap = "-" if drive.longest_gap_m is None else f"{drive.longest_gap_m:.0f} m"
        drives.add_row(
            str(drive.drive), escape(drive.lane), drive.condition, str(drive.fixes), _cm(drive.fix_rms_m),
            gap + (" (estimated)" if drive.gap_estimated else ""), _cm(drive.path_rms_m), _cm(drive.path_worst_m),
            str(drive.wrong),
        )  # fmt: skip
    console.print(drives)
    weak = Table("weak marker", "kind", "lane", "chainage", "read", "cause")
    for marker in report.list_weak()[:_SHOWN_WEAK]:
        weak.add_row(
            str(marker.number), marker.kind, escape(marker.lane), f"{marker.chainage_m:.1f} m",
            f"{marker.read} of {marker.passes}", marker.cause or "-",
        )  # fmt: skip
    if report.weak:
        console.print(weak)
    console.print(f"  weak markers: {len(report.weak)}; wrong readings: {len(report.wrong)}")
    for drive in report.drives:
        for refusal in drive.refusals:
            console.print(
                f"  [yellow]no path[/] in drive {drive.drive} on lane {escape(drive.lane)}: {escape(refusal)}"
            )
    console.print(f"  files: {escape(str(folder / 'proof.json'))}, proof.csv")


def _cm(value_m: float | None) -> str:
    return "-" if value_m is None else f"{100 * value_m:.1f} cm"
