"""Messages on disk until the server has accepted them. No message that was acknowledged to a broker is lost."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import orjson

_COLLECTING = "collecting.jsonl"
_BATCH = "batch-*.jsonl"


class Spool:
    """A folder of messages as JSON lines: one file that is appended to, and batches that wait to be sent.

    Parameters
    ----------
    folder : Path
        Created if need be; one process at a time.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._refused = folder / "refused"
        self._refused.mkdir(parents=True, exist_ok=True)
        self._file = (folder / _COLLECTING).open("ab")
        self.messages = self._count()
        """Number of messages in the file that is appended to."""

    def add(self, messages: Iterable[dict[str, Any]]) -> None:
        """Append messages; they are on the disk when this returns."""
        lines = [orjson.dumps(message) + b"\n" for message in messages]
        self._file.write(b"".join(lines))
        self._file.flush()
        os.fsync(self._file.fileno())
        self.messages += len(lines)

    def cut(self) -> Path | None:
        """Turn the collected messages into a batch; its name stays its idempotency key."""
        if not self.messages:
            return None
        self._file.close()
        batch = self._folder / f"batch-{uuid.uuid4()}.jsonl"
        (self._folder / _COLLECTING).rename(batch)
        self._file = (self._folder / _COLLECTING).open("ab")
        self.messages = 0
        return batch

    def list_batches(self) -> list[Path]:
        """Batches that wait, oldest first."""
        return sorted(self._folder.glob(_BATCH), key=lambda path: path.stat().st_mtime_ns)

    def refuse(self, batch: Path, why: dict[str, Any]) -> None:
        """Set aside a batch that the server refused finally, with the problem document."""
        (self._refused / f"{batch.stem}.problem.json").write_bytes(orjson.dumps(why, option=orjson.OPT_INDENT_2))
        batch.rename(self._refused / batch.name)

    def close(self) -> None:
        """Close the file that is appended to."""
        self._file.close()

    def _count(self) -> int:
        path = self._folder / _COLLECTING
        content = path.read_bytes()
        if content and not content.endswith(
            b"\n"
        ):  # the machine stopped in the middle of a line, before it was acknowledged
            whole = content[: content.rfind(b"\n") + 1]
            path.write_bytes(whole)
            content = whole
        return content.count(b"\n")
