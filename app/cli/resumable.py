"""Large files to a server by tus 1.0: after an interruption, also of this command, the upload goes on where it was."""

from __future__ import annotations

import base64
import hashlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from app.errors import Unavailable

if TYPE_CHECKING:
    import httpx

    from app.cli.progress import Progress

_TUS = {"Tus-Resumable": "1.0.0"}
_BLOCK_BYTES = 256 * 1024
_BUSY = (409, 423, 429, 503)
"""Answers after which the same upload goes on: another request is writing it, or the server is busy or starting."""
_PAUSES_S = (0.2, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0)
"""Pauses after interruptions in a row; after the last one the command gives up. Source: chosen by hand."""
Check = Callable[["httpx.Response"], object]


class ResumableUpload:
    """A file on its way to a server.

    Parameters
    ----------
    client : httpx.Client
    file : Path
    context : str
        JSON.
    shown : Progress
    check : callable
        Raises `WaymarkError` for a response that is no success.
    """

    def __init__(self, client: httpx.Client, file: Path, context: str, shown: Progress, check: Check) -> None:
        self._client, self._file, self._context = client, file, context
        self._shown, self._check = shown, check
        self._size = file.stat().st_size
        self._memory = _memory_of(f"{client.base_url}\n{file.resolve()}\n{file.stat().st_mtime_ns}\n{context}")

    def send(self) -> str:
        """Send what the server does not have yet; returns the path of the decode.

        Raises
        ------
        WaymarkError
            The server refuses the file.
        Unavailable
            The connection breaks again and again.
        """
        import httpx

        failures = reached = 0
        while True:
            try:
                place, offset, decode = self._begin()
                if decode is None:
                    failures, reached = (failures, reached) if offset <= reached else (0, offset)
                    response = self._append(place, offset)
                    if response.status_code not in _BUSY:
                        if response.is_client_error:
                            self._forget()
                        self._check(response)
                        decode = response.headers["Waymark-Decode"]
            except httpx.TransportError as error:
                if failures == len(_PAUSES_S):
                    raise Unavailable(
                        f"the connection to {self._client.base_url} broke: {error}",
                        cure="run the command again: the upload goes on where it was",
                    ) from error
                decode = None
            if decode is not None:
                self._forget()
                return decode
            if failures == len(_PAUSES_S):
                raise Unavailable("the server is busy with this upload", cure="run the command again in a minute")
            time.sleep(_PAUSES_S[failures])
            failures += 1

    def _begin(self) -> tuple[str, int, str | None]:
        """Path of the upload, its offset and, once it is complete, its decode; a new one if there is none yet."""
        place = self._remembered()
        if place is not None:
            found = self._client.head(place, headers=_TUS)
            if found.is_success:
                return place, int(found.headers["Upload-Offset"]), found.headers.get("Waymark-Decode")
            self._forget()
        pairs = {"filename": self._file.name, "context": self._context}
        metadata = ",".join(f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in pairs.items())
        headers = {**_TUS, "Upload-Length": str(self._size), "Upload-Metadata": metadata}
        made = self._client.post("/v1/uploads", headers=headers)
        self._check(made)
        place = str(made.headers["Location"])
        self._remember(place)
        return place, 0, None

    def _append(self, place: str, offset: int) -> httpx.Response:
        headers = {
            **_TUS, "Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream",
            "Content-Length": str(self._size - offset),
        }  # fmt: skip
        body = self._shown.counted("upload", self._blocks(offset), self._size, done=offset)
        return self._client.patch(place, content=body, headers=headers)

    def _blocks(self, offset: int) -> Iterator[bytes]:
        with self._file.open("rb") as opened:
            opened.seek(offset)
            while block := opened.read(_BLOCK_BYTES):
                yield block

    # --- what the next run of the command needs; without it the file is sent from its beginning ----------------------

    def _remembered(self) -> str | None:
        try:
            return self._memory.read_text(encoding="utf-8")
        except OSError:
            return None

    def _remember(self, place: str) -> None:
        with suppress(OSError):
            self._memory.parent.mkdir(parents=True, exist_ok=True)
            self._memory.write_text(place, encoding="utf-8")

    def _forget(self) -> None:
        with suppress(OSError):
            self._memory.unlink()


def _memory_of(what: str) -> Path:
    folder = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(folder, "waymark", "uploads", hashlib.sha256(what.encode()).hexdigest()[:32])
