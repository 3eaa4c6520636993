"""The running server carries out operations of commands: one process owns the embedded database."""

from __future__ import annotations

import os
import socket
import struct
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import orjson
import structlog

from app.control.client import MAX_FILES, MAX_REQUEST_BYTES, receive_all, short_address, socket_path
from app.control.operations import OPERATIONS, OperatorCases, Report, show_nothing
from app.errors import InvalidParameter, Unavailable, WaymarkError

_LOG = structlog.get_logger("waymark.control")
_REQUEST_S = 10.0
"""Longest wait for a request that a client has begun. [s] It comes from the same machine."""
_CREDENTIALS = struct.Struct("3i")  # pid, uid, gid: unix(7), SO_PEERCRED
_AT_ONCE = 4  # operations at a time
_REPORT_EVERY_S = 0.2


class ControlServer:
    """Listens while the server runs, on a socket that only its user and root may use.

    Parameters
    ----------
    database : Path
        The file beside which the socket is.
    """

    def __init__(self, database: Path, cases: OperatorCases) -> None:
        self._path = socket_path(database)
        self._cases = cases
        self._listener: socket.socket | None = None
        self._places = threading.BoundedSemaphore(_AT_ONCE)

    def open(self) -> None:
        """Begin to listen. What a killed server left is replaced: whoever owns the database owns the socket."""
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        os.fchmod(listener.fileno(), 0o600)
        self._path.unlink(missing_ok=True)
        with short_address(self._path) as address:
            listener.bind(address)
        self._path.chmod(0o600)
        listener.listen()
        self._listener = listener
        threading.Thread(target=self._accept, args=(listener,), name="control", daemon=True).start()

    def close(self) -> None:
        """Take no more requests."""
        if self._listener is not None:
            self._path.unlink(missing_ok=True)
            with suppress(OSError):
                self._listener.shutdown(socket.SHUT_RDWR)
            self._listener.close()
            self._listener = None

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return  # closed
            threading.Thread(target=self._serve, args=(connection,), name="control-request", daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        files: list[int] = []
        with connection:
            try:
                connection.settimeout(_REQUEST_S)
                first, files, _, _ = socket.recv_fds(connection, 65_536, MAX_FILES)
                request = first + receive_all(connection, MAX_REQUEST_BYTES)
                connection.settimeout(None)
                _check_peer(connection)  # after it was read: a client that still sends would not read the reason
                answer = self._answer(request, files, connection)
            except WaymarkError as error:
                answer = {"error": _described(error)}
            except OSError:
                return
            finally:
                for file in files:
                    os.close(file)
            with suppress(OSError):
                connection.sendall(orjson.dumps(answer))

    def _answer(self, request: bytes, files: Sequence[int], connection: socket.socket) -> dict[str, object]:
        try:
            document = orjson.loads(request)
            name, values = document["operation"], document["values"]
            operation = OPERATIONS[name]
            report = _reporter(connection) if document.get("progress") else show_nothing
        except (ValueError, KeyError, TypeError) as error:
            raise InvalidParameter(
                "the server does not know this operation", cure="use the server's version"
            ) from error
        if not self._places.acquire(timeout=_REQUEST_S):
            raise Unavailable("other commands are running", cure="try again in a few seconds")
        try:
            result = operation(self._cases, values, files, report)
        except WaymarkError:
            raise
        except Exception as error:
            _LOG.exception("a command failed on a defect", operation=name)
            raise WaymarkError("the command failed on a defect; the server's log has the details") from error
        finally:
            self._places.release()
        _LOG.info("command", operation=name, agency_name=values.get("agency"))
        return {"result": result}


def _reporter(connection: socket.socket) -> Report:
    """Sends progress as lines before the answer. A client that does not read misses some: nobody waits for it."""
    last: dict[str, float] = {}

    def report(step: str, done: float, total: float) -> None:
        now_s = time.monotonic()
        if done < total and now_s - last.get(step, -_REPORT_EVERY_S) < _REPORT_EVERY_S:
            return
        last[step] = now_s
        with suppress(OSError):
            connection.send(orjson.dumps({"progress": [step, done, total]}) + b"\n", socket.MSG_DONTWAIT)

    return report


def _check_peer(connection: socket.socket) -> None:
    """Only the server's user and root may give orders, whatever the rights of the file."""
    raw = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    _pid, user, _group = _CREDENTIALS.unpack(raw)
    if user not in (0, os.geteuid()):
        raise Unavailable("this user may not run commands of this server", cure="run it as the server's user")


def _described(error: WaymarkError) -> dict[str, str | None]:
    return {"message": error.message, "field": error.field, "limit": error.limit, "cure": error.cure}
