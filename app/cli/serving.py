"""The server's process: its sockets, its limits, and its end within seconds."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import signal
import socket
import sys
import threading
from contextlib import suppress
from types import FrameType

import structlog
import uvicorn

from app.api.http.connections import ConnectionLimits, limited_connections
from app.cli.terminal import collector_paused
from app.errors import InvalidParameter
from app.settings import Settings

_GRACE_S = 2
"""How long running requests may go on after SIGTERM; then the decoder processes are stopped. [s]"""
_END_S = 4.0
"""When the process ends after SIGTERM, whatever still runs. [s] Nothing is lost: a transaction is committed as a whole
or not at all, and the next start goes on with unfinished jobs."""
_SWITCH_S = 0.0005
"""[s] after which a thread lets others run Python. Source: `python -m benchmarks.service --only overload`: with the
usual 5 ms a request that passes through several threads while 64 clients upload waits for up to a second."""
_FILES_PER_CONNECTION = 2
"""A connection and its upload. Databases, decoder processes and logs take fewer than `_OTHER_FILES`, or half of the
files where there are few; a server of two decoder processes has 60 open."""
_OTHER_FILES = 512
_BACKLOG = 2048
"""Connections that the kernel accepts before the server does. Source: default of uvicorn."""
_MIN_CONNECTIONS = 8
_ARENAS = 2
"""Heaps that the threads share. Each keeps what its threads once used. One for each of two cores."""
_M_ARENA_MAX = -8  # glibc's mallopt
_NOT_STARTED = 3
"""Exit status; source: STARTUP_FAILURE of uvicorn."""
_LOG = structlog.get_logger(__name__)


class StoppingServer(uvicorn.Server):
    """A server that ends within `_END_S` after SIGTERM or Ctrl-C."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, and leave what is in memory then out of garbage collection: it stays until the end.

        A collection stops all threads, and with a million objects of modules it takes 0.3 s.
        """
        await super().startup(sockets)
        gc.collect()
        gc.freeze()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to stop; the next SIGTERM ends the process at once."""
        super().handle_exit(sig, frame)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        end = threading.Timer(_END_S, _end)
        end.daemon = True
        end.start()


def serve_until_stopped(settings: Settings) -> None:
    """Serve until SIGTERM or Ctrl-C.

    Raises
    ------
    InvalidParameter
        The address or the port cannot be used.
    """
    _share_heaps()
    with collector_paused():
        from app.main import create_app

    check_port(settings.host, settings.port)
    total, backlog = _possible_connections(settings.max_connections)
    limits = ConnectionLimits(
        header_s=settings.header_timeout_s,
        stall_s=settings.body_timeout_s,
        min_bytes_per_s=settings.min_bytes_per_s,
        total=total,
        per_address=max(1, settings.max_connections_per_address * total // settings.max_connections),
        proxies=frozenset(settings.proxies),
    )
    sys.setswitchinterval(_SWITCH_S)
    config = uvicorn.Config(
        create_app(settings),
        host=settings.host,
        port=settings.port,
        http=limited_connections(limits),
        proxy_headers=bool(settings.proxies),
        forwarded_allow_ips=settings.proxies,
        ws="none",
        log_config=None,
        access_log=False,
        backlog=backlog,
        server_header=False,
        timeout_keep_alive=settings.keep_alive_s,
        timeout_graceful_shutdown=_GRACE_S,
    )
    server = StoppingServer(config)
    with suppress(KeyboardInterrupt):  # raised again by uvicorn after it has stopped
        server.run()
    if not server.started:
        raise SystemExit(_NOT_STARTED)


def _share_heaps() -> None:
    """Have all threads allocate from few heaps: one for each thread takes memory that no other can use."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # of glibc
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, _ARENAS)


def check_port(host: str, port: int) -> None:
    """Refuse a port that another program uses, before the server starts with all its parts."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise InvalidParameter(
            f"the server cannot listen on {host}, port {port}: {error.strerror}",
            field="WAYMARK_PORT",
            cure="stop the program that uses the port, or choose another: WAYMARK_PORT=8001, or serve --port 8001",
        ) from error


def _possible_connections(wanted: int) -> tuple[int, int]:
    """How many connections there may be, and how many may wait in the kernel, with the files that may be open.

    Many systems start with 1,024 files: the limit is raised to what is needed, or to the hard limit. Those that wait
    are accepted all at once, before the first of them is refused, so they need files, too.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = _FILES_PER_CONNECTION * wanted + _BACKLOG + _OTHER_FILES
    files = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    if soft != resource.RLIM_INFINITY and soft < files:
        resource.setrlimit(resource.RLIMIT_NOFILE, (files, hard))
    left = files - min(_OTHER_FILES, files // 2)
    backlog = min(_BACKLOG, left // 4)
    possible = max(_MIN_CONNECTIONS, min(wanted, (left - backlog) // _FILES_PER_CONNECTION))
    if possible < wanted:
        _LOG.warning(
            "fewer connections are allowed than WAYMARK_MAX_CONNECTIONS: raise the limit of open files (ulimit -Hn)",
            connections=possible, wanted=wanted, open_files=files, needed=needed,
        )  # fmt: skip
    return possible, backlog


def _end() -> None:
    _LOG.warning("requests or jobs that did not end in time are interrupted")
    os.kill(os.getpid(), signal.SIGTERM)
