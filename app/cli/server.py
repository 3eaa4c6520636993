"""Commands that run the server, a worker or the ingest from a broker, prepare the database and create keys."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from app.cli.database import owned_database, perform, read_settings
from app.cli.terminal import collector_paused
from app.errors import InvalidParameter, Unavailable
from app.values import JsonObject

HostOption = Annotated[str | None, typer.Option(help="Address to listen on. Default: WAYMARK_HOST, or 127.0.0.1.")]
PortOption = Annotated[int | None, typer.Option(help="Port to listen on. Default: WAYMARK_PORT, or 8000.")]


def serve(host: HostOption = None, port: PortOption = None) -> None:
    """Start the server. On an empty database it prints the first admin key."""
    from app.cli.serving import serve_until_stopped
    from app.control.exporting import start_tracing
    from app.logs import configure_logs

    settings = read_settings(host=host, port=port)
    configure_logs(settings.log_format, settings.log_level)
    start_tracing(settings, "waymark-server")
    with owned_database(settings) as database:
        database.migrate()  # what is wrong is one line here, and would be a traceback of the server later
    serve_until_stopped(settings)


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the results; created if it does not exist.")] = Path("demo-out"),
    serve: Annotated[
        bool, typer.Option("--serve", help="Leave the server running afterwards, on WAYMARK_HOST and WAYMARK_PORT.")
    ] = False,
) -> None:
    """Register plates, magnets and CERPMs, decode simulated drives past them, and print a table for each family."""
    from app.demo import run_demo

    signal.signal(signal.SIGTERM, _end)
    where = _address_to_serve_on() if serve else {}
    if not run_demo(out, say=lambda line: typer.echo(line), keep_serving=serve, **where):
        raise typer.Exit(1)


def _address_to_serve_on() -> JsonObject:
    """Host, and port if the environment has one: by default the demo takes any free port."""
    from app.cli.serving import check_port

    settings = read_settings()
    if "port" not in settings.model_fields_set:
        return {"host": settings.host}
    check_port(settings.host, settings.port)
    return {"host": settings.host, "port": settings.port}


def _end(number: int, _frame: FrameType | None) -> None:
    """End as after Ctrl-C: the demo's server is stopped on the way."""
    raise SystemExit(128 + number)


def compile_kernels() -> None:
    """Compile the decoders' numerical kernels into the cache, so that no drive waits for it."""
    from app.jobs.compile_kernels import compile_kernels

    compile_kernels()


def migrate(
    revision: Annotated[str, typer.Argument(help="Revision to migrate to, newer or older.")] = "head",
) -> None:
    """Migrate the database's schema to a revision. `waymark serve` migrates to the newest one by itself."""
    with owned_database(read_settings()) as database:
        try:
            database.migrate(revision)
        except InvalidParameter as error:
            typer.echo(f"waymark: {error.message}; allowed: {error.limit}", err=True)
            raise typer.Exit(2) from None
    typer.echo(f"{database.name} is at revision {revision}")


def key(
    agency: Annotated[
        str | None, typer.Argument(help="Name of the agency; it is created if it does not exist.")
    ] = None,
    scope: Annotated[str | None, typer.Option(help="admin, planner (default), surveyor, viewer or vehicle.")] = None,
    label: Annotated[str, typer.Option(help="Who or what the key is for; shown in histories.")] = "key",
    days: Annotated[
        int | None, typer.Option(min=1, max=3653, help="Days until the key expires. Default: never.")
    ] = None,
    operator: Annotated[
        bool, typer.Option("--operator", help="Instead of an agency's: a key that creates agencies over HTTP.")
    ] = False,
) -> None:
    """Create a key for an agency, or for an operator, and print it once, also while the server runs."""
    if operator == (agency is not None) or (operator and scope is not None):
        raise InvalidParameter(
            "a key is either an agency's or an operator's",
            field="agency",
            limit="AGENCY with or without --scope, or --operator without both",
            cure="waymark key AGENCY --scope planner, or waymark key --operator",
        )
    values = {"agency": agency, "scope": scope or "planner", "label": label, "days": days}
    typer.echo(perform(read_settings(), "key", values)["key"])


# === The command that runs jobs from the broker's queues.


_END_S = 8.0
"""When the process ends after SIGTERM, whatever still runs. [s] Nothing is lost: its jobs run again elsewhere."""
_QUEUES = "online,proof,archive"


def worker(
    queues: Annotated[str, typer.Option(help="Queues to take jobs from, separated by commas.")] = _QUEUES,
    concurrency: Annotated[
        int, typer.Option(min=1, max=64, help="Number of jobs of each queue that run at the same time.")
    ] = 1,
) -> None:
    """Run jobs from the queues of WAYMARK_BROKER_URL until the command is stopped."""
    from app.control.exporting import start_tracing
    from app.logs import configure_logs
    from app.services.jobs import QueueName

    settings = read_settings()
    configure_logs(settings.log_format, settings.log_level)
    start_tracing(settings, "waymark-worker")
    try:
        names = [QueueName(name.strip()) for name in queues.split(",") if name.strip()]
    except ValueError as error:
        raise InvalidParameter(str(error), field="--queues", limit=_QUEUES) from error
    if not names:
        raise InvalidParameter("a worker needs a queue", field="--queues", limit=_QUEUES)
    with collector_paused():
        from app.worker import running_worker

    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: stopped.set())
    with running_worker(settings, list(dict.fromkeys(names)), concurrency) as running:
        while not stopped.wait(1.0):
            if not running.is_running:
                raise Unavailable("the worker stopped on an error; its log has the details")
        end = threading.Timer(_END_S, os._exit, (1,))
        end.daemon = True
        end.start()


# === The command that uploads packets of CERPMs from a message broker.


_HELP = "Upload what live sources deliver."
ingest_cli = typer.Typer(no_args_is_help=True, help=_HELP)


@ingest_cli.callback(help=_HELP)
def ingest() -> None:
    """Group the commands `waymark ingest ...`."""


@ingest_cli.command()
def mqtt(
    broker: Annotated[str, typer.Option(help="mqtt://[USER:PASSWORD@]HOST[:PORT], or mqtts://.")],
    key: Annotated[str, typer.Option(envvar="WAYMARK_KEY", help="Key with the scope vehicle.")],
    server: Annotated[str, typer.Option(help="Address of the Waymark server.")] = "http://127.0.0.1:8000",
    topic: Annotated[
        list[str] | None, typer.Option(help="Topic; may be repeated. Default: ChirpStack and The Things Stack.")
    ] = None,
    client_id: Annotated[
        str, typer.Option(help="Client identifier, under which the broker queues messages.")
    ] = "waymark-ingest",
    spool: Annotated[
        Path, typer.Option(help="Folder for messages that are not uploaded yet; created if it does not exist.")
    ] = Path("spool"),
    batch_s: Annotated[float, typer.Option(min=0.1, help="Longest time between two uploads. [s]")] = 10.0,
    batch_messages: Annotated[int, typer.Option(min=1, max=100_000, help="Maximum packets in one upload.")] = 1000,
    context: Annotated[str, typer.Option(help="Context of each upload, JSON; see docs/cerpms.md.")] = '{"packets": {}}',
) -> None:
    """Collect uplinks of CERPMs from a broker and upload them as packet logs, until the command is stopped."""
    import signal

    import orjson

    from app.ingest import DEFAULT_TOPICS, MqttIngest, MqttSource, Sink
    from app.logs import configure_logs

    settings = read_settings()
    configure_logs(settings.log_format, settings.log_level)
    try:
        upload_context = orjson.loads(context)
    except orjson.JSONDecodeError as error:
        raise InvalidParameter(f"--context is not JSON: {error}", field="context") from error
    source = MqttSource(broker, tuple(topic or DEFAULT_TOPICS), client_id)
    running = MqttIngest(source, Sink(server, key, upload_context, batch_messages, batch_s), spool)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: running.stop())
    running.run()
