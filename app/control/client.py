"""Commands that work with and without a running server."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import orjson

from app.control.operations import OPERATIONS, OperatorCases, Report, Values, show_nothing
from app.errors import Unavailable, WaymarkError
from app.registry.database import Database
from app.registry.engines import across_agencies

# === The socket through which commands reach the server: beside the database, for its user alone.


NAME = "control.sock"
MAX_REQUEST_BYTES = 1024**2
"""Largest request; files are passed as descriptors. [byte] A declaration has at most 64 KiB."""
MAX_FILES = 4


def socket_path(database: Path) -> Path:
    """Where the server of a database file listens."""
    return database.with_name(f"{database.name}.{NAME}")


@contextmanager
def short_address(path: Path) -> Iterator[str]:
    """An address of the socket that is short enough: the kernel takes 107 bytes, and folders may be deeper."""
    folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


def receive_all(connection: socket.socket, limit: int) -> bytes:
    """Everything until the other side stops sending, at most `limit` bytes."""
    content = b""
    while len(content) <= limit and (part := connection.recv(65_536)):
        content += part
    return content


# === Commands that work with and without a running server.


_PATIENCE_S = 20.0
"""How long a server that starts or stops is waited for: it owns the database before it listens. [s]"""
_AGAIN_S = 0.1
_MAX_ANSWER_BYTES = 512 * 1024**2


def perform(
    url: str, name: str, values: Values, make_cases: Callable[[Database], OperatorCases], files: Sequence[int] = (),
    report: Report = show_nothing,
) -> Values:  # fmt: skip
    """Carry out an operation: in this process if no other owns the database, else in the server.

    Parameters
    ----------
    url : str
        Of the database.
    name : str
        Of the operation.
    values : mapping
        Its arguments, JSON.
    make_cases : callable
        The use cases on a database that this process has opened and migrated.
    files : sequence of int
        Descriptors of open files.
    report : callable, optional
        Shows progress.

    Raises
    ------
    WaymarkError
        The operation was refused.
    """
    last_s = time.monotonic() + _PATIENCE_S
    while True:
        database = Database(url)
        try:
            database.open()
        except Unavailable:
            if database.path is None:
                raise
            with _connected(database) as connection:
                if connection is not None:
                    return _ask(connection, name, values, files, report)
            if time.monotonic() > last_s:
                raise
            time.sleep(_AGAIN_S)
            continue
        try:
            database.migrate()
            with across_agencies():
                return OPERATIONS[name](make_cases(database), values, files, report)
        finally:
            database.close()


@contextmanager
def _connected(database: Database) -> Iterator[socket.socket | None]:
    """A connection to the server of the database; None if none listens."""
    assert database.path is not None
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        try:
            with short_address(socket_path(database.path)) as address:
                connection.connect(address)
        except OSError:
            yield None
            return
        yield connection


def _ask(connection: socket.socket, name: str, values: Values, files: Sequence[int], report: Report) -> Values:
    request = orjson.dumps({"operation": name, "values": values, "progress": True})
    try:
        sent = socket.send_fds(connection, [request], list(files)) if files else connection.send(request)
        connection.sendall(request[sent:])
        connection.shutdown(socket.SHUT_WR)
        with connection.makefile("rb") as lines:
            while "progress" in (answer := orjson.loads(lines.readline(_MAX_ANSWER_BYTES))):
                report(*answer["progress"])
    except (OSError, ValueError) as error:
        raise Unavailable(
            "the server ended before it answered; the command may have been carried out or not",
            cure="look whether it was, and repeat it if not",
        ) from error
    if fault := answer.get("error"):
        raise WaymarkError(fault["message"], field=fault["field"], limit=fault["limit"], cure=fault["cure"])
    result: Values = answer["result"]
    return result
