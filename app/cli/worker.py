"""The command that runs jobs from the broker's queues."""

from __future__ import annotations

import os
import signal
import threading
from typing import Annotated

import typer

from app.cli.database import read_settings
from app.cli.loading import collector_paused
from app.errors import InvalidParameter, Unavailable

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
    from app.services.job_queues import QueueName

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
