"""Commands that talk to a server: upload with progress, artwork, reprocessing."""

from __future__ import annotations

import base64
import hashlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.terminal import JsonOption, Progress
from app.errors import InvalidParameter, Unavailable, WaymarkError
from app.values import JsonObject

if TYPE_CHECKING:
    import httpx


# === Large files to a server by tus 1.0: after an interruption, also of this command, the upload goes on where it was.


_TUS = {"Tus-Resumable": "1.0.0"}
_BLOCK_BYTES = 256 * 1024
_BUSY = (409, 423, 429, 503)
"""Answers after which the same upload goes on: another request is writing it, or the server is busy or starting."""
_PAUSES_S = (0.2, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0)
"""Pauses after interruptions in a row; after the last one the command gives up."""
Check = Callable[["httpx.Response"], object]


class ResumableUpload:
    """A file on its way to a server.

    Parameters
    ----------
    context : str
        JSON.
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


# === Commands that talk to a server.


ServerOption = Annotated[str, typer.Option(help="Address of the server.")]
KeyOption = Annotated[str, typer.Option(envvar="WAYMARK_KEY", help="Key to send; better set it in WAYMARK_KEY.")]
_SERVER = "http://127.0.0.1:8000"
_PART = 256 * 1024
_RETRY_S = 1.0
_SMALL_BYTES = 8 * 1024**2
"""Larger files are sent so that the upload can go on after an interruption. [byte]"""


def upload(
    file: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="Frame, ZIP, video, trace or packet log.")],
    server: ServerOption = _SERVER,
    key: KeyOption = "",
    context: Annotated[str, typer.Option(help="Context as JSON; see the API's /docs.")] = "{}",
    as_json: JsonOption = False,
) -> None:
    """Upload a file to a server, wait until it is decoded, and print what was found.

    A file of more than 8 MiB is sent by tus: run the command again after an interruption, and it goes on where it was.
    """
    with _client(server, key) as client, Progress(quiet=as_json) as shown:
        decode = _sent(client, file, context, shown)
        if decode["state"] != "done":
            follow_job(client, decode["id"], shown)
            decode = _checked(client.get(f"/v1/decodes/{decode['id']}"))
    if as_json:
        _print_json(decode)
    elif decode["state"] == "done":
        typer.echo(decode["summary"]["text"])
        typer.echo(f"{server}{decode['links']['self']}")
    if decode["state"] != "done":
        raise _failure(decode)


def _sent(client: httpx.Client, file: Path, context: str, shown: Progress) -> JsonObject:
    """Send a file; returns its decode, which may be a job still."""
    if file.stat().st_size > _SMALL_BYTES:
        return _checked(client.get(ResumableUpload(client, file, context, shown, _checked).send()))
    body, headers = _multipart(file, context)
    sent = shown.counted("upload", body, int(headers["Content-Length"]))
    return _checked(client.post("/v1/decodes", content=sent, headers=headers))


def artwork(
    out: Annotated[Path, typer.Argument(dir_okay=False, help="ZIP to write; it must not exist.")],
    marker: Annotated[list[str] | None, typer.Option(help="Id of a plate; may be repeated.")] = None,
    status: Annotated[str | None, typer.Option(help="All plates with this status.")] = None,
    form: Annotated[list[str] | None, typer.Option("--format", help="pdf, svg, dxf or png; may be repeated.")] = None,
    server: ServerOption = _SERVER,
    key: KeyOption = "",
    as_json: JsonOption = False,
) -> None:
    """Have a server draw plates, each read back, and write the ZIP."""
    if out.exists():
        raise InvalidParameter(f"{out} already exists", cure="remove it, or choose another name")
    wanted: dict[str, object] = {"formats": form} if form else {}
    wanted |= {"marker_ids": marker} if marker else {"status": status}
    with _client(server, key) as client, Progress(quiet=as_json) as shown:
        job = _checked(client.post("/v1/artwork", json=wanted, headers={"Prefer": "respond-async"}))
        done = follow_job(client, job["id"], shown)
        if done["state"] != "done":
            raise _failure(done)
        with client.stream("GET", done["links"]["result"]) as response:
            response.raise_for_status()
            with out.open("xb") as target:
                size = int(response.headers["content-length"])
                for part in shown.counted("download", response.iter_bytes(_PART), size):
                    target.write(part)
    if as_json:
        _print_json(done)
    else:
        typer.echo(out)


def reprocess(
    kind: Annotated[list[str] | None, typer.Option(help="Kind of uploads; may be repeated.")] = None,
    older_than: Annotated[str | None, typer.Option(help="Results of earlier releases, e.g. 0.3.0.")] = None,
    since: Annotated[str | None, typer.Option(help="Uploaded at this time or later (RFC 3339).")] = None,
    until: Annotated[str | None, typer.Option(help="Uploaded before this time (RFC 3339).")] = None,
    vehicle: Annotated[str | None, typer.Option(help="Id of a vehicle.")] = None,
    bbox: Annotated[str | None, typer.Option(help="Coarse positions in west,south,east,north. [deg]")] = None,
    report: Annotated[Path | None, typer.Option(help="File for the report as CSV.")] = None,
    approve: Annotated[str | None, typer.Option(help="Id of a reprocessing to approve; nothing else is done.")] = None,
    server: ServerOption = _SERVER,
    key: KeyOption = "",
    as_json: JsonOption = False,
) -> None:
    """Have a server decode stored uploads again, and print what changed. Nothing changes before it is approved."""
    box = _box(bbox) if bbox else None
    with _client(server, key) as client, Progress(quiet=as_json) as shown:
        if approve is not None:
            found = _checked(client.post(f"/v1/reprocessings/{approve}/approve"))
        else:
            wanted = {
                "kinds": kind, "older_than": older_than, "since": since, "until": until, "vehicle_id": vehicle,
                "bbox": box,
            }  # fmt: skip
            chosen = {name: value for name, value in wanted.items() if value is not None}
            found = _checked(client.post("/v1/reprocessings", json=chosen))
            while found["state"] == "running":
                shown.show("reprocess", found["done"], found["total"])
                time.sleep(_RETRY_S)
                found = _checked(client.get(found["links"]["self"]))
            shown.show("reprocess", found["done"], found["total"])
            if report is not None:
                report.write_bytes(client.get(found["links"]["csv"]).raise_for_status().content)
    if as_json:
        _print_json(found)
        return
    sums = ", ".join(f"{count} {name}" for name, count in found["summary"].items())
    typer.echo(f"{found['id']} {found['state']}: {found['done']} of {found['total']} uploads; readings: {sums}")


def _box(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError as error:
        raise InvalidParameter(
            f"--bbox {text[:80]!r} is not made of numbers", field="--bbox", limit="west,south,east,north in degrees",
            cure="for example --bbox 8.0,49.0,8.5,49.5",
        ) from error  # fmt: skip


def follow_job(client: httpx.Client, job_id: str, shown: Progress) -> JsonObject:
    """Follow a job by server-sent events until it ends; a stream that is cut is opened again."""
    import httpx

    last = ""
    while True:
        try:
            with client.stream("GET", f"/v1/jobs/{job_id}/events", headers={"Last-Event-ID": last}) as response:
                if response.status_code not in (200, 204):
                    response.read()
                    _checked(response)
                for name, event_id, job in _events(response.iter_lines()):
                    last = event_id
                    if name != "progress":
                        if name == "done":
                            _show_job(shown, job, is_done=True)
                        return job
                    _show_job(shown, job)
        except (httpx.RemoteProtocolError, httpx.ReadError, httpx.ConnectError):
            time.sleep(_RETRY_S)


def _show_job(shown: Progress, job: JsonObject, *, is_done: bool = False) -> None:
    """A job by its steps, where they are counted."""
    if job["total"]:
        shown.show(job["kind"], job["total"] if is_done else job["done"], job["total"])
    else:
        shown.show(job["kind"], 1.0 if is_done else job["progress"], 1.0)


def _events(lines: Iterator[str]) -> Iterator[tuple[str, str, dict[str, object]]]:
    import orjson

    fields: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(": ")
        if name:
            fields[name] = value
        elif line == "" and "data" in fields:
            yield fields["event"], fields["id"], orjson.loads(fields["data"])
            fields = {}


@contextmanager
def _client(server: str, key: str) -> Iterator[httpx.Client]:
    """A client of a server; what goes wrong on the way is an error with its cure."""
    import httpx

    if not key:
        raise InvalidParameter("no key was given", field="--key", cure="set WAYMARK_KEY, or give --key")
    headers = {"Authorization": f"Bearer {key}"}
    try:
        timeout = httpx.Timeout(60.0, read=300.0)
        with httpx.Client(base_url=server.rstrip("/"), headers=headers, timeout=timeout) as client:
            yield client
    except (httpx.InvalidURL, httpx.UnsupportedProtocol) as error:
        raise InvalidParameter(
            f"{server!r} is no address of a server", field="--server", limit="http:// or https://, a host and a port",
            cure="for example --server https://waymark.example.org",
        ) from error  # fmt: skip
    except httpx.TransportError as error:
        raise Unavailable(
            f"the server at {server} does not answer: {error}", cure="check --server, and that the server runs"
        ) from error
    except httpx.HTTPStatusError as error:
        raise WaymarkError(f"the server answered {error.response.status_code} to {error.request.url.path}") from error


def _multipart(file: Path, context: str) -> tuple[Iterator[bytes], dict[str, str]]:
    """The body of a form with a file, part by part, and its headers: a large file is never in memory."""
    boundary = "waymark-upload-boundary"
    name = file.name.encode("ascii", "replace").decode().replace('"', "_")
    head = (
        f'--{boundary}\r\nContent-Disposition: form-data; name="context"\r\nContent-Type: application/json\r\n\r\n'
        f'{context}\r\n--{boundary}\r\nContent-Disposition: form-data; name="file"; filename="{name}"\r\n'
        "Content-Type: application/octet-stream\r\n\r\n"
    ).encode()
    end = f"\r\n--{boundary}--\r\n".encode()
    size = len(head) + file.stat().st_size + len(end)

    def parts() -> Iterator[bytes]:
        yield head
        with file.open("rb") as opened:
            while part := opened.read(_PART):
                yield part
        yield end

    return parts(), {"Content-Type": f"multipart/form-data; boundary={boundary}", "Content-Length": str(size)}


def _checked(response: httpx.Response) -> JsonObject:
    """The document of a response.

    Raises
    ------
    WaymarkError
        The server refused the request.
    """
    try:
        document: JsonObject = response.json()
    except ValueError:
        document = {}
    if response.is_success:
        return document
    message = document.get("detail") or f"the server answered {response.status_code}"
    raise WaymarkError(message, limit=document.get("limit"), cure=document.get("cure"))


def _failure(job: JsonObject) -> WaymarkError:
    error = job.get("error") or {}
    return WaymarkError(
        error.get("detail") or f"it was {job['state']}", limit=error.get("limit"), cure=error.get("cure")
    )


def _print_json(document: dict[str, object]) -> None:
    import orjson

    typer.echo(orjson.dumps(document, option=orjson.OPT_INDENT_2))
