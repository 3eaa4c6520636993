"""`waymark`: the command line, a thin shell over the use cases and the codecs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from pydantic import ValidationError

from app.errors import InvalidParameter, WaymarkError
from app.settings import Settings

if TYPE_CHECKING:
    from app.registry.database import Database
    from app.services.access import Caller

cli = typer.Typer(name="waymark", no_args_is_help=True, add_completion=False, pretty_exceptions_show_locals=False)

HostOption = Annotated[str | None, typer.Option(help="Address to listen on; WAYMARK_HOST or 127.0.0.1 without.")]
PortOption = Annotated[int | None, typer.Option(help="Port to listen on; WAYMARK_PORT or 8000 without.")]


@cli.callback()
def waymark() -> None:
    """The registry of machine-readable roads."""


@cli.command()
def serve(host: HostOption = None, port: PortOption = None) -> None:
    """Serve the API; on a fresh machine print the first admin key."""
    import uvicorn

    from app.logs import configure_logs
    from app.main import create_app

    settings = _settings(host=host, port=port)
    configure_logs(settings.log_format, settings.log_level)
    with _owned_database(settings):
        pass  # a file that another process owns is said in one line here, not in a traceback from the server
    uvicorn.run(
        create_app(settings),
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=30,
    )


@cli.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder to write to; created if need be.")] = Path("demo-out"),
    serve: Annotated[bool, typer.Option("--serve", help="Leave the server running to look around in.")] = False,
) -> None:
    """Register plates and magnets, write artwork and drilling sheets, decode simulated drives over them; two tables."""
    from app.demo import run_demo

    if not run_demo(out, say=lambda line: typer.echo(line), keep_serving=serve):
        raise typer.Exit(1)


@cli.command()
def migrate(revision: Annotated[str, typer.Argument(help="Revision to go to, up or down.")] = "head") -> None:
    """Bring the database's schema to a revision; `serve` goes to the newest by itself."""
    with _owned_database(_settings()) as database:
        database.migrate(revision)
    typer.echo(f"{database.name} is at revision {revision}")


@cli.command()
def key(
    agency: Annotated[str, typer.Argument(help="Name of the agency; created if there is none of that name.")],
    scope: Annotated[str, typer.Option(help="admin, planner, surveyor, viewer or vehicle.")] = "planner",
    label: Annotated[str, typer.Option(help="Who or what the key is for; appears in histories.")] = "key",
    days: Annotated[int | None, typer.Option(min=1, max=3653, help="Days until it expires; never without.")] = None,
) -> None:
    """Make a key for an agency and print it once. A server on a SQLite file must not be running."""
    from datetime import timedelta

    from app.main import utc_now
    from app.services.access import Access, parse_scope

    with _owned_database(_settings()) as database:
        database.migrate()
        expires_at = utc_now() + timedelta(days=days) if days else None
        typer.echo(Access(database, utc_now).create_key(agency, parse_scope(scope), label, expires_at))


@cli.command("import")
def import_survey(
    survey: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="CSV, GeoJSON, GeoPackage, ...")],
    agency: Annotated[str, typer.Option(help="Name of the agency whose markers these are.")],
    declared: Annotated[str, typer.Option(help="What is declared of it, JSON; see docs/imports.md.")] = "{}",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Report only; nothing is stored.")] = False,
    map_file: Annotated[Path | None, typer.Option("--map", help="SVG of the residuals of a comparison.")] = None,
) -> None:
    """Import a survey of any size; prints the report, and ends with 1 if it is refused.

    A server on a SQLite file must not be running.
    """
    import orjson

    from app.api.schemas_imports import DeclarationIn
    from app.jobs.survey_child import SurveysHere
    from app.main import marker_rules, utc_now
    from app.services.imports import Imports

    try:
        declaration = DeclarationIn.model_validate_json(declared)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise InvalidParameter(f"--declared {place}: {first['msg']}", cure="see docs/imports.md") from error
    given = declaration.model_copy(update={"dry_run": dry_run or declaration.dry_run}).given(survey.read_bytes())
    settings = _settings()
    with _owned_database(settings) as database:
        database.migrate()
        with _operator(database, agency) as caller:
            report, _ = Imports(database, utc_now, SurveysHere(), marker_rules(settings)).run(caller, given)
    if map_file is not None and report["comparison"] is not None:
        map_file.write_text(report["comparison"].pop("map_svg") or "")
    typer.echo(orjson.dumps(report, option=orjson.OPT_INDENT_2))
    if report["outcome"] == "refused":
        raise typer.Exit(1)


@cli.command()
def export(
    out: Annotated[Path, typer.Argument(dir_okay=False, help="File to write; it must not be there.")],
    agency: Annotated[str, typer.Option(help="Name of the agency whose markers are wanted.")],
    kind: Annotated[str, typer.Option("--format", help="csv, geojson, gpkg, shapefile, kml, landxml or dxf.")] = "gpkg",
    bbox: Annotated[str | None, typer.Option(help="west,south,east,north. [deg]")] = None,
    status: Annotated[str | None, typer.Option(help="Only markers with this status.")] = None,
    family: Annotated[str | None, typer.Option(help="Only plates, magnets or cerpms: plate, magnet or cerpm.")] = None,
) -> None:
    """Write an agency's markers to a file. A server on a SQLite file must not be running."""
    from tempfile import TemporaryDirectory

    from app.api.marker_filter import parse_box
    from app.registry.markers import MarkerFilter
    from app.services.exports import KINDS, Exports

    if kind not in KINDS:
        raise InvalidParameter(f"there is no format {kind[:40]!r}", limit=", ".join(KINDS))
    if out.exists():
        raise InvalidParameter(f"{out} is there already", cure="remove it, or choose another name")
    narrowed = MarkerFilter(box=parse_box(bbox) if bbox else None, status=status, family=family)
    with _owned_database(_settings()) as database, TemporaryDirectory(dir=out.parent, prefix=".waymark-") as folder:
        database.migrate()
        with _operator(database, agency) as caller:
            Exports(database).write_file(caller, kind, narrowed, Path(folder)).rename(out)
    typer.echo(out)


snapshot = typer.Typer(no_args_is_help=True, help="Files of an area for vehicles without a connection.")
cli.add_typer(snapshot, name="snapshot")


@snapshot.callback()
def snapshots() -> None:
    """Files of an area for vehicles without a connection."""


@snapshot.command("make")
def make_snapshot(
    out: Annotated[Path, typer.Argument(dir_okay=False, help="File to write; it must not be there.")],
    agency: Annotated[str, typer.Option(help="Name of the agency whose markers are wanted.")],
    bbox: Annotated[str, typer.Option(help="west,south,east,north. [deg]")],
    hours: Annotated[float, typer.Option(help="How long it holds. [h]")] = 24.0,
) -> None:
    """Write the signed snapshot of an area; prints the public key that vehicles verify it with."""
    from app.api.marker_filter import parse_box
    from app.main import utc_now
    from app.services.snapshots import Snapshots
    from app.storage.signing_key import load_signing_key

    if out.exists():
        raise InvalidParameter(f"{out} is there already", cure="remove it, or choose another name")
    box, settings = parse_box(bbox), _settings()
    with _database_beside_a_server(settings) as database, _operator(database, agency) as caller:
        service = Snapshots(database, utc_now, lambda: load_signing_key(settings.resolved_signing_key_file))
        content = service.make(caller, box, hours)
        public_key = service.public_key().public_key.hex()
    with out.open("xb") as file:
        file.write(content)
    typer.echo(f"{out}: {len(content)} bytes, public key {public_key}")


@snapshot.command("verify")
def verify_snapshot(
    file: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="A snapshot.")],
    key: Annotated[
        str | None, typer.Option(help="Public key, hexadecimal; without, that of this server's signing key.")
    ] = None,
) -> None:
    """Verify a snapshot as a vehicle does; prints what it holds, and ends with 1 if it is refused."""
    import orjson

    from app.decoders.snapshot import open_snapshot
    from app.main import utc_now
    from app.storage.signing_key import load_signing_key

    path = _settings().resolved_signing_key_file
    if key is None and not path.exists():
        raise InvalidParameter(f"there is no signing key {path}", cure="give the server's public key with --key")
    try:
        public_key = bytes.fromhex(key) if key is not None else load_signing_key(path).public_key().public_bytes_raw()
    except ValueError as error:
        raise InvalidParameter("--key is not hexadecimal", limit="32 bytes, 64 digits") from error
    if len(public_key) != 32:
        raise InvalidParameter(f"--key has {len(public_key)} bytes", limit="32 bytes, 64 digits")
    held = open_snapshot(file.read_bytes(), public_key, utc_now()).summary()
    typer.echo(orjson.dumps(held, option=orjson.OPT_INDENT_2))


audit = typer.Typer(no_args_is_help=True, help="The log of what changed the registry.")
cli.add_typer(audit, name="audit")


@audit.callback()
def audit_log() -> None:
    """The log of what changed the registry."""


@audit.command()
def verify(
    agency: Annotated[str | None, typer.Argument(help="Name of one agency; all without.")] = None,
    expect_head: Annotated[
        str | None, typer.Option(help="NUMBER:HASH of an entry as an earlier run printed it; needs an agency.")
    ] = None,
) -> None:
    """Compute every hash of the history again; names each fault and ends with 1 if there is any."""
    from app.services.audit import AuditLog, parse_head

    if expect_head is not None and agency is None:
        raise InvalidParameter("a head belongs to one agency's log", field="expect-head", cure="name the agency")
    expected = parse_head(expect_head) if expect_head is not None else None
    is_good = True
    with _database_beside_a_server(_settings()) as database:
        for name, report, faults in AuditLog(database).verify(agency, expected):
            for fault in faults:
                is_good = False
                typer.echo(f"{name}: {fault.where}: {fault.what}")
            head = f", head {report.head[0]}:{report.head[1]}" if report.head is not None else ""
            typer.echo(f"{name}: {report.entries} entries, {report.versions} versions{head}")
    if not is_good:
        raise typer.Exit(1)


@cli.command()
def encode(
    out: Annotated[Path, typer.Option(help="Folder to write to; created if need be.")] = Path("."),
    lon_deg: Annotated[float | None, typer.Option(help="Longitude of a position plate. [deg]")] = None,
    lat_deg: Annotated[float | None, typer.Option(help="Latitude of a position plate. [deg]")] = None,
    check_digits: Annotated[int, typer.Option(min=0, max=2, help="Check digits of a position plate.")] = 0,
    registry_number: Annotated[int | None, typer.Option(help="Number of an id plate.")] = None,
    n: Annotated[int, typer.Option(help="Units along a side: 8, 10 or 12.")] = 8,
    unit_mm: Annotated[float, typer.Option(help="Side of a unit. [mm]")] = 35.0,
    gap_mm: Annotated[float, typer.Option(help="Gap between units. [mm]")] = 5.0,
    thickness_mm: Annotated[float, typer.Option(help="Thickness of the base plate. [mm]")] = 20.0,
    form: Annotated[list[str] | None, typer.Option("--format", help="svg, pdf, dxf or png; may be repeated.")] = None,
) -> None:
    """Write the artwork of one plate at true size, read back before it is written."""
    from app.decoders.plate import decode_plates
    from app.encoders.plate import ArtworkFormat
    from app.markers.plate import PlateGeometry
    from app.services.plate_files import encode_plate_files, plate_code_for

    unknown = sorted(set(form or ()) - set(ArtworkFormat))
    if unknown:
        raise InvalidParameter(f"there is no format {unknown[0]}", limit=", ".join(ArtworkFormat))
    position = (lon_deg, lat_deg) if lon_deg is not None and lat_deg is not None else None
    files = encode_plate_files(
        plate_code_for(position, registry_number, n=n, check_digits=check_digits),
        PlateGeometry(n, unit_mm, gap_mm, thickness_mm),
        [ArtworkFormat(name) for name in form or ("svg", "pdf")],
        position=position,
        read=lambda image, geometry: decode_plates(image, geometries=(geometry,)),
    )
    out.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (out / name).write_bytes(content)
        typer.echo(out / name)


@cli.command()
def board(
    out: Annotated[Path, typer.Option(help="Folder to write to; created if need be.")] = Path("."),
    columns: Annotated[int, typer.Option(help="Squares across.")] = 7,
    rows: Annotated[int, typer.Option(help="Squares down.")] = 10,
    square_mm: Annotated[float, typer.Option(help="Side of a square. [mm]")] = 25.0,
    marker_mm: Annotated[float, typer.Option(help="Side of a marker. [mm]")] = 18.0,
    form: Annotated[list[str] | None, typer.Option("--format", help="svg, pdf, dxf or png; may be repeated.")] = None,
) -> None:
    """Write a board to calibrate cameras with, at true size; print it at 100 %."""
    from app.encoders.calibration_board import encode_board
    from app.encoders.plate import ArtworkFormat, write_artwork
    from app.sensors.calibration_board import CalibrationBoard

    unknown = sorted(set(form or ()) - set(ArtworkFormat))
    if unknown:
        raise InvalidParameter(f"there is no format {unknown[0]}", limit=", ".join(ArtworkFormat))
    drawing = encode_board(CalibrationBoard(columns, rows, square_mm, marker_mm))
    out.mkdir(parents=True, exist_ok=True)
    for name in form or ("pdf",):
        path = out / f"waymark-board-{columns}x{rows}-{square_mm:g}mm.{name}"
        path.write_bytes(write_artwork(drawing, ArtworkFormat(name)).content)
        typer.echo(path)


@cli.command()
def decode(
    pictures: Annotated[list[Path], typer.Argument(exists=True, dir_okay=False, help="JPEG or PNG files.")],
    thermal: Annotated[bool, typer.Option(help="The pictures come from a thermal camera.")] = False,
) -> None:
    """Read the plates in pictures; prints one JSON object a picture."""
    import orjson

    from app.decoders.images import ImageLimits
    from app.decoders.plate import decode_plates
    from app.services.plate_files import decode_picture

    limits = ImageLimits(pixels=_settings().max_image_pixels)
    for picture in pictures:
        found = decode_picture(picture.name, picture.read_bytes(), decode=decode_plates, limits=limits, thermal=thermal)
        typer.echo(orjson.dumps(found, option=orjson.OPT_SERIALIZE_NUMPY))


@cli.command()
def decode_trace(
    recording: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="A file, or a ZIP of one recording.")],
    declared: Annotated[str, typer.Option(help="What is declared of it, JSON; see docs/magnets.md.")] = "{}",
    plot: Annotated[Path | None, typer.Option(help="SVG to write.")] = None,
) -> None:
    """Read the magnets and tags in a magnetometer trace; prints one JSON object."""
    import orjson

    from app.decoders.magnet.registered import match_tags
    from app.jobs.trace_child import decode_recording
    from app.services.trace_documents import trace_document
    from app.services.traces import TraceTask, trace_terms

    try:
        terms: object = orjson.loads(declared)
    except orjson.JSONDecodeError as error:
        raise InvalidParameter(f"--declared is not JSON: {error}", field="declared", cure="send {} at least") from error
    if not isinstance(terms, dict):
        raise InvalidParameter("--declared is no JSON object", field="declared", cure="send {} at least")
    result = decode_recording(TraceTask(recording.name, recording.read_bytes(), terms), None)
    trace = match_tags(result.findings, (), trace_terms(terms).bar)
    if plot is not None:
        plot.write_bytes(result.plot)
    document = trace_document(result, trace, codebook_tags=0)
    typer.echo(orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY))


ingest = typer.Typer(no_args_is_help=True, help="Send on what live sources deliver.")
cli.add_typer(ingest, name="ingest")


@ingest.callback()
def ingest_sources() -> None:
    """Send on what live sources deliver."""


@ingest.command()
def mqtt(
    broker: Annotated[str, typer.Option(help="mqtt://[USER:PASSWORD@]HOST[:PORT], or mqtts://.")],
    key: Annotated[str, typer.Option(envvar="WAYMARK_KEY", help="Key with the scope vehicle.")],
    server: Annotated[str, typer.Option(help="Where Waymark listens.")] = "http://127.0.0.1:8000",
    topic: Annotated[list[str] | None, typer.Option(help="May be repeated; ChirpStack's and TTS's without.")] = None,
    client_id: Annotated[str, typer.Option(help="Name under which the broker keeps what waits.")] = "waymark-ingest",
    spool: Annotated[Path, typer.Option(help="Folder of what is not sent yet; created if need be.")] = Path("spool"),
    batch_s: Annotated[float, typer.Option(min=0.1, help="Longest that packets are collected. [s]")] = 10.0,
    batch_messages: Annotated[int, typer.Option(min=1, max=100_000, help="Most packets of one upload.")] = 1000,
    context: Annotated[str, typer.Option(help="Context of each upload, JSON; see docs/cerpms.md.")] = '{"packets": {}}',
) -> None:
    """Collect uplinks of CERPMs from a broker and upload them as packet logs, until it is stopped."""
    import signal

    import orjson

    from app.ingest.mqtt import DEFAULT_TOPICS, MqttIngest, MqttSource, Sink
    from app.logs import configure_logs

    settings = _settings()
    configure_logs(settings.log_format, settings.log_level)
    try:
        said = orjson.loads(context)
    except orjson.JSONDecodeError as error:
        raise InvalidParameter(f"--context is not JSON: {error}", field="context") from error
    source = MqttSource(broker, tuple(topic or DEFAULT_TOPICS), client_id)
    running = MqttIngest(source, Sink(server, key, said, batch_messages, batch_s), spool)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: running.stop())
    running.run()


@contextmanager
def _owned_database(settings: Settings) -> Iterator[Database]:
    from app.registry.database import Database
    from app.registry.tenancy import across_agencies

    database = Database(settings.resolved_database_url)
    database.open()
    try:
        with across_agencies():
            yield database
    finally:
        database.close()


@contextmanager
def _database_beside_a_server(settings: Settings) -> Iterator[Database]:
    """The database for reading only, whoever owns it."""
    from app.registry.database import Database, head_revision
    from app.registry.tenancy import across_agencies

    database = Database(settings.resolved_database_url)
    if database.path is not None and not database.path.exists():
        raise InvalidParameter(f"there is no database {database.name}", cure="set WAYMARK_DATA_DIR or _DATABASE_URL")
    try:
        if database.current_revision() != head_revision():
            raise InvalidParameter(f"{database.name} has an older schema", cure="run waymark migrate")
        with across_agencies():
            yield database
    finally:
        database.close()


@contextmanager
def _operator(database: Database, agency: str) -> Iterator[Caller]:
    """Whoever may use the command line of the server, on behalf of an agency."""
    from app.registry.agencies import find_agency
    from app.registry.tenancy import across_agencies, acting_for
    from app.services.access import Caller, Scope

    with across_agencies(), database.read() as connection:
        agency_id = find_agency(connection, agency)
    if agency_id is None:
        raise InvalidParameter(f"there is no agency {agency[:80]!r}", cure="waymark key makes one")
    with acting_for(agency_id):
        yield Caller(agency_id, "command-line", "command line", Scope.ADMIN)


def _settings(**given: object) -> Settings:
    try:
        return Settings.model_validate({name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        name = "WAYMARK_" + "_".join(str(part) for part in first["loc"]).upper()
        raise InvalidParameter(f"{name.removesuffix('_')}: {first['msg']}", cure="see docs/settings.md") from error


def main() -> None:
    """Run the command line; an expected error is one line, not a traceback."""
    try:
        cli()
    except WaymarkError as error:
        typer.echo(f"waymark: {error.message}", err=True)
        for name in ("limit", "cure"):
            if value := getattr(error, name):
                typer.echo(f"  {name}: {value}", err=True)
        raise SystemExit(1) from None
