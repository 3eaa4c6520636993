"""Nothing that was acknowledged is lost."""

from __future__ import annotations

from pathlib import Path

import orjson

from app.ingest import Spool


def lines(path: Path) -> list[object]:
    return [orjson.loads(line) for line in path.read_bytes().splitlines()]


def test_messages_become_batches_that_outlive_the_process(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    assert spool.cut() is None
    spool.add([{"n": 1}, {"n": 2}])
    assert spool.messages == 2
    batch = spool.cut()
    assert batch is not None
    assert spool.messages == 0
    spool.add([{"n": 3}])
    spool.close()
    again = Spool(tmp_path)
    assert again.list_batches() == [batch]
    assert lines(batch) == [{"n": 1}, {"n": 2}]
    assert again.messages == 1
    second = again.cut()
    assert second is not None
    assert lines(second) == [{"n": 3}]
    assert again.list_batches() == [batch, second]
    again.close()


def test_half_a_line_is_what_was_never_acknowledged(tmp_path: Path) -> None:
    (tmp_path / "collecting.jsonl").write_bytes(b'{"n": 1}\n{"n": 2')
    spool = Spool(tmp_path)
    assert spool.messages == 1
    spool.add([{"n": 3}])
    batch = spool.cut()
    assert batch is not None
    assert lines(batch) == [{"n": 1}, {"n": 3}]
    spool.close()


def test_a_refused_batch_is_put_aside_with_its_problem(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    spool.add([{"n": 1}])
    batch = spool.cut()
    assert batch is not None
    spool.refuse(batch, {"title": "no"})
    assert spool.list_batches() == []
    kept = sorted(path.name for path in (tmp_path / "refused").iterdir())
    assert kept == sorted([batch.name, f"{batch.stem}.problem.json"])
    spool.close()
