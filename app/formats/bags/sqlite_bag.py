"""ROS 2 bags in SQLite (.db3), read as the files of strangers: no view, trigger or function of theirs runs."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from urllib.parse import quote

from app.errors import UnsupportedUpload
from app.formats.format import SpooledFile

_TABLES = {"topics", "messages"}


class SqliteBag:
    """An open bag; its `metadata.yaml` is not needed.

    Parameters
    ----------
    max_bytes : int
        Largest message. [byte]

    Attributes
    ----------
    topics : list of (str, str, str)
        Name, type and encoding of each.

    Raises
    ------
    UnsupportedUpload
        The database is no bag.
    sqlite3.Error
        It is damaged.
    """

    def __init__(self, file: SpooledFile, max_bytes: int) -> None:
        if file.path is None:
            self._database = sqlite3.connect(":memory:")
            self._database.deserialize(file.read())
        else:
            self._database = sqlite3.connect(f"file:{quote(str(file.path))}?mode=ro&immutable=1", uri=True)
        try:
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max_bytes)
            self._database.execute("PRAGMA trusted_schema = 0")
            self._database.execute("PRAGMA query_only = 1")
            found = self._database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
            if not {name for (name,) in found} >= _TABLES:
                raise UnsupportedUpload(
                    "the SQLite file is no ROS 2 bag", field="file", limit="a file with the tables topics and messages",
                    cure="send the .db3 file that ros2 bag record has written",
                )  # fmt: skip
            rows = self._database.execute("SELECT id, name, type, serialization_format FROM topics ORDER BY id")
            self._topics = {int(number): tuple(map(str, named)) for number, *named in rows}
        except BaseException:
            self.close()
            raise
        self.topics = list(self._topics.values())

    def messages(
        self, topics: Collection[str], start_ns: int | None, end_ns: int | None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of recording [ns] and content of each message, by time; from a time on and before another one."""
        wanted = {number: topic[0] for number, topic in self._topics.items() if topic[0] in topics}
        numbers = ",".join(map(str, wanted))  # integers, checked above
        rows = self._database.execute(
            f"SELECT rowid, topic_id, timestamp FROM messages WHERE topic_id IN ({numbers}) "
            "AND timestamp >= ? AND timestamp < ? ORDER BY timestamp",
            (start_ns if start_ns is not None else 0, end_ns if end_ns is not None else 2**63 - 1),
        )
        for row, number, time_ns in rows:  # contents are fetched one by one: sorting must not hold them
            (data,) = self._database.execute("SELECT data FROM messages WHERE rowid = ?", (row,)).fetchone()
            yield wanted[number], int(time_ns), bytes(data)

    def close(self) -> None:
        """Close the file."""
        self._database.close()
