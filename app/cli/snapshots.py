"""Commands that make and verify snapshots for vehicles without a connection."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.cli.database import operator, read_settings, readable_database
from app.errors import InvalidParameter

_HELP = "Signed files with the markers of an area, for vehicles without a connection."
cli = typer.Typer(no_args_is_help=True, help=_HELP)


@cli.callback(help=_HELP)
def snapshot() -> None:
    """Group the commands `waymark snapshot ...`."""


@cli.command("make")
def make_snapshot(
    out: Annotated[Path, typer.Argument(dir_okay=False, help="File to write; it must not exist.")],
    agency: Annotated[str, typer.Option(help="Name of the agency that owns the markers.")],
    bbox: Annotated[str, typer.Option(help="Area as west,south,east,north. [deg]")],
    hours: Annotated[float, typer.Option(help="Hours until the snapshot expires. [h]")] = 24.0,
) -> None:
    """Write the signed snapshot of an area, and print the public key that vehicles verify it with."""
    from app.api.markers.filters import parse_box
    from app.main import utc_now
    from app.services.fleet.snapshots import Snapshots
    from app.storage.signing_key import load_signing_key

    if out.exists():
        raise InvalidParameter(f"{out} already exists", cure="remove it, or choose another name")
    box, settings = parse_box(bbox), read_settings()
    with readable_database(settings) as database, operator(database, agency) as caller:
        service = Snapshots(database, utc_now, lambda: load_signing_key(settings.resolved_signing_key_file))
        content = service.make(caller, box, hours)
        public_key = service.public_key().public_key.hex()
    with out.open("xb") as file:
        file.write(content)
    typer.echo(f"{out}: {len(content)} bytes, public key {public_key}")


@cli.command("verify")
def verify_snapshot(
    file: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="Snapshot to verify.")],
    key: Annotated[
        str | None, typer.Option(help="Public key, hexadecimal. Default: that of this server's signing key.")
    ] = None,
) -> None:
    """Verify a snapshot as a vehicle does, and print what it contains. The exit status is 1 if it is refused."""
    import orjson

    from app.decoders.snapshot import open_snapshot
    from app.main import utc_now
    from app.storage.signing_key import load_signing_key

    path = read_settings().resolved_signing_key_file
    if key is None and not path.exists():
        raise InvalidParameter(f"there is no signing key {path}", cure="state the server's public key with --key")
    try:
        public_key = bytes.fromhex(key) if key is not None else load_signing_key(path).public_key().public_bytes_raw()
    except ValueError as error:
        raise InvalidParameter("--key is not hexadecimal", limit="32 bytes, 64 digits") from error
    if len(public_key) != 32:
        raise InvalidParameter(f"--key has {len(public_key)} bytes", limit="32 bytes, 64 digits")
    summary = open_snapshot(file.read_bytes(), public_key, utc_now()).summary()
    typer.echo(orjson.dumps(summary, option=orjson.OPT_INDENT_2))
