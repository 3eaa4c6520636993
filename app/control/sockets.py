"""The socket through which commands reach the server: beside the database, for its user alone."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NAME = "control.sock"
MAX_REQUEST_BYTES = 1024**2
"""Largest request; files are passed as descriptors. [byte] Source: by hand, a declaration has at most 64 KiB."""
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
