"""Files of exports, each written in a process of its own: GDAL holds the interpreter for seconds, as others do."""

from __future__ import annotations

import multiprocessing
import resource
import time
from collections.abc import Iterable, Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path

from app.errors import ProcessStopped
from app.formats.exports import Record, WrittenFile, write_file
from app.jobs.decoder_process import end_with_parent
from app.services.request_work import add_processor_time, check_deadline, stopping

_CHECK_S = 0.2
_PROCESSES = multiprocessing.get_context("forkserver")


class ExportProcesses:
    """Writes files as `app.formats.exports.write_file` does, each in a process that ends with the file.

    Parameters
    ----------
    memory_bytes : int
        Private memory of a process. [byte]
    """

    def __init__(self, memory_bytes: int) -> None:
        self._memory_bytes = memory_bytes

    def write(self, kind: str, pages: Iterable[Sequence[Record]], folder: Path, *, all_heights: bool) -> WrittenFile:
        """Send the pages to a process as they come, and wait for its file.

        Raises
        ------
        ProcessStopped
            The file takes more memory than a process has, or the process was stopped.
        ClientLeft
            The client of the request has left; the process is stopped.
        """
        ours, theirs = _PROCESSES.Pipe()
        arguments = (theirs, kind, folder, all_heights, self._memory_bytes)
        process = _PROCESSES.Process(target=_write, args=arguments, daemon=True)
        process.start()
        theirs.close()
        try:
            with stopping(process.kill):
                _send(ours, pages)
                while not ours.poll(_CHECK_S):
                    check_deadline()
                answer, used_s = ours.recv()
        except EOFError as error:
            check_deadline()
            raise _stopped() from error
        finally:
            process.kill()
            process.join()
            process.close()
            ours.close()
        add_processor_time(used_s)
        if isinstance(answer, Exception):
            raise answer
        written: WrittenFile = answer
        return written


def _send(connection: Connection, pages: Iterable[Sequence[Record]]) -> None:
    """Send the pages and the end; a process that reads no further has an answer already, or was stopped."""
    for page in pages:
        check_deadline()
        try:
            connection.send(page)
        except OSError:
            return
    try:
        connection.send(None)
    except OSError:
        return


def _stopped(limit: str | None = None) -> ProcessStopped:
    return ProcessStopped(
        "the process that wrote the file was stopped" if limit is None else "the file takes too much memory",
        field="bbox",
        limit=limit,
        cure="export a smaller box, or CSV or GeoJSON",
    )


def _write(connection: Connection, kind: str, folder: Path, all_heights: bool, memory_bytes: int) -> None:
    """The process: write the file, and answer with it or with the error, and the processor time. [s]"""
    end_with_parent()
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, hard))
    answer: WrittenFile | Exception
    try:
        answer = write_file(kind, _received(connection), folder, all_heights=all_heights)
    except MemoryError:
        answer = _stopped(f"{memory_bytes} bytes")
    except Exception as error:  # noqa: BLE001 - raised again where the file is waited for
        answer = error
    connection.send((answer, time.process_time()))


def _received(connection: Connection) -> Iterator[Sequence[Record]]:
    while (page := connection.recv()) is not None:
        yield page
