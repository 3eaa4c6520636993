"""Commands that make and verify snapshots for vehicles without a connection."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.database import read_settings, readable_database
from app.errors import InvalidParameter
from app.settings import Settings

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

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
    hours: Annotated[float, typer.Option(help="Hours until the snapshot expires, at most 168. [h]")] = 24.0,
) -> None:
    """Write the signed snapshot of an area."""
    from app.control.operations import operator
    from app.services.fleet.snapshots import Snapshots
    from app.services.markers.searches import parse_box
    from app.services.ports import utc_now

    _refuse_existing(out)
    box, settings = parse_box(bbox), read_settings()
    with readable_database(settings) as database, operator(database, agency) as caller:
        content = Snapshots(database, utc_now, _signing_keys(settings)).make(caller, box, hours)
    with out.open("xb") as file:
        file.write(content)
    typer.echo(f"{out}: {len(content)} bytes")


@cli.command("trust")
def write_trust(
    out: Annotated[Path, typer.Argument(dir_okay=False, help="File to write; it must not exist.")],
    agency: Annotated[str, typer.Option(help="Name of the agency whose snapshots are verified.")],
) -> None:
    """Write the trust file of an agency: what its vehicles verify snapshots with."""
    import orjson

    from app.control.operations import operator
    from app.services.fleet.documents import trust_document
    from app.services.fleet.snapshots import Snapshots
    from app.services.ports import utc_now

    _refuse_existing(out)
    settings = read_settings()
    with readable_database(settings) as database, operator(database, agency) as caller:
        trust = Snapshots(database, utc_now, _signing_keys(settings)).trust(caller)
    with out.open("xb") as file:
        file.write(orjson.dumps(trust_document(trust), option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE))
    typer.echo(f"{out}: {len(trust.public_keys)} trusted " + ("key" if len(trust.public_keys) == 1 else "keys"))


@cli.command("verify")
def verify_snapshot(
    file: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="Snapshot to verify.")],
    trust: Annotated[Path, typer.Option(exists=True, dir_okay=False, help="Trust file of the agency.")],
    memory: Annotated[
        Path | None, typer.Option(dir_okay=False, help="File that remembers the newest snapshot; created if missing.")
    ] = None,
) -> None:
    """Verify a snapshot as a vehicle does, and print what it contains. The exit status is 1 if it is refused."""
    import orjson

    from app.decoders.snapshot import open_newest_snapshot, open_snapshot
    from app.markers.snapshot import Trust
    from app.services.ports import utc_now

    try:
        trusted = Trust.from_document(orjson.loads(trust.read_bytes()))
    except orjson.JSONDecodeError as error:
        raise InvalidParameter(f"{trust} is not JSON", cure="write it with waymark snapshot trust") from error
    data, now = file.read_bytes(), utc_now()
    if memory is None:
        snapshot = open_snapshot(data, trusted, now)
    else:
        snapshot = open_newest_snapshot(data, trusted, now, memory)
    typer.echo(orjson.dumps(snapshot.summary(), option=orjson.OPT_INDENT_2))


class Step(StrEnum):
    """A step of a rotation of keys."""

    ADD = "add"
    SWITCH = "switch"
    REMOVE = "remove"


@cli.command("rotate")
def rotate_keys(
    step: Annotated[
        Step,
        typer.Argument(
            help="add: a new key is trusted and does not sign yet; switch: the other key signs; remove: the key that "
            "does not sign is no longer trusted."
        ),
    ],
) -> None:
    """Change this server's signing keys, and print the public keys, that of the signing key first."""
    from app.storage.keys import add_signing_key, load_signing_keys, remove_signing_key, switch_signing_keys

    steps = {Step.ADD: add_signing_key, Step.SWITCH: switch_signing_keys, Step.REMOVE: remove_signing_key}
    path = read_settings().resolved_signing_key_file
    steps[step](path)
    for key in load_signing_keys(path):
        typer.echo(key.public_key().public_bytes_raw().hex())


def _refuse_existing(out: Path) -> None:
    if out.exists():
        raise InvalidParameter(f"{out} already exists", cure="remove it, or choose another name")


def _signing_keys(settings: Settings) -> Callable[[], tuple[Ed25519PrivateKey, ...]]:
    from app.storage.keys import load_signing_keys

    return partial(load_signing_keys, settings.resolved_signing_key_file)
