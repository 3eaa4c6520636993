"""The command that uploads packets of CERPMs from a message broker."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.cli.database import read_settings
from app.errors import InvalidParameter

_HELP = "Upload what live sources deliver."
cli = typer.Typer(no_args_is_help=True, help=_HELP)


@cli.callback(help=_HELP)
def ingest() -> None:
    """Group the commands `waymark ingest ...`."""


@cli.command()
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

    from app.ingest.mqtt import DEFAULT_TOPICS, MqttIngest, MqttSource, Sink
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
