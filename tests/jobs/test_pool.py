"""Decoder processes: real ones, really killed."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future

import pytest

from app.errors import InvalidParameter, Unavailable, UnreadableUpload
from app.jobs import keeper
from app.jobs.child import ChildLimits
from app.jobs.keeper import Pending
from app.jobs.pool import DecodePool
from app.markers.plate import PlateCode
from app.markers.reading import PlateOutcome
from app.services.frames import AnnotationTask, FrameResult, FrameTask, Outline, PlateSearch
from tests.jobs import standin
from tests.uploads.pictures import huge_png, jpeg, lying_png, png

CODE = PlateCode.from_position(8.5, 49.0)


@pytest.fixture(scope="module")
def pool() -> Iterator[DecodePool]:
    made = DecodePool(standin.decode, workers=2, limits=ChildLimits(timeout_s=2.0))
    made.open()
    yield made
    made.close()


def known(search: PlateSearch) -> Future[PlateSearch]:
    future: Future[PlateSearch] = Future()
    future.set_result(search)
    return future


def start(pool: DecodePool, what: int) -> Pending[FrameResult]:
    return pool.start(FrameTask(png(standin.frame_that(what))), known(PlateSearch(codebook=(CODE,))))


def child_of(pool: DecodePool) -> int:
    return int(start(pool, standin.OBEY).result().readings[0].reason.split()[0])


def test_a_frame_goes_there_and_back(pool: DecodePool) -> None:
    result = start(pool, standin.OBEY).result()
    assert (result.header.width_px, result.header.height_px) == (96, 64)
    assert result.readings[0].outcome is PlateOutcome.READ
    assert result.readings[0].digits == CODE.digits
    pid, cv2_threads = result.readings[0].reason.split()
    assert int(pid) != os.getpid()
    assert cv2_threads == "1"


def test_a_refusal_keeps_its_field_limit_and_cure(pool: DecodePool) -> None:
    with pytest.raises(InvalidParameter) as caught:
        start(pool, standin.RAISE).result()
    assert (caught.value.message, caught.value.field, caught.value.limit, caught.value.cure) == ("no", "a.b", "c", "d")


def test_a_defect_stays_a_defect(pool: DecodePool) -> None:
    with pytest.raises(ZeroDivisionError):
        start(pool, standin.BUG).result()


def test_a_killed_process_loses_only_its_own_frame(pool: DecodePool) -> None:
    good = [start(pool, standin.OBEY) for _ in range(4)]
    bad = start(pool, standin.DIE)
    more = [start(pool, standin.OBEY) for _ in range(4)]
    assert [p.result().readings[0].digits for p in good] == [CODE.digits] * 4
    with pytest.raises(UnreadableUpload, match="stopped the decoder process"):
        bad.result()
    assert [p.result().readings[0].digits for p in more] == [CODE.digits] * 4


def test_killing_idle_processes_costs_no_frame(pool: DecodePool) -> None:
    for _round in range(2):
        os.kill(child_of(pool), signal.SIGKILL)
        assert start(pool, standin.OBEY).result().readings[0].digits == CODE.digits
        time.sleep(0.5)
        assert start(pool, standin.OBEY).result().readings[0].digits == CODE.digits


def test_a_process_killed_from_outside_is_tried_again(pool: DecodePool) -> None:
    """An out-of-memory killer takes a child in the middle of somebody's good frame."""
    slow = DecodePool(slow_decode, workers=1, limits=ChildLimits(timeout_s=30))
    slow.open()
    try:
        victim = int(start(slow, standin.OBEY).result().readings[0].reason)
        pending = start(slow, standin.OBEY)
        time.sleep(0.2)
        os.kill(victim, signal.SIGKILL)
        assert int(pending.result().readings[0].reason) != victim
    finally:
        slow.close()


def slow_decode(pixels: object, **_options: object) -> list[object]:
    time.sleep(0.6)
    return standin.decode(pixels)  # type: ignore[return-value]


def test_a_frame_that_takes_too_long_is_stopped(pool: DecodePool) -> None:
    began = time.monotonic()
    with pytest.raises(UnreadableUpload, match="too long") as caught:
        start(pool, standin.SLEEP).result()
    assert 1.9 < time.monotonic() - began < 8
    assert caught.value.limit == "2 s a file"
    assert child_of(pool)


def test_a_running_frame_can_be_cancelled(pool: DecodePool) -> None:
    pending = start(pool, standin.SLEEP)
    threading.Timer(0.3, pending.cancel).start()
    began = time.monotonic()
    with pytest.raises(Unavailable):
        pending.result()
    assert time.monotonic() - began < 8  # what runs into its time ends as UnreadableUpload, above
    assert child_of(pool)


def test_memory_has_a_limit(pool: DecodePool) -> None:
    with pytest.raises(UnreadableUpload, match="more memory") as caught:
        start(pool, standin.HOG).result()
    assert caught.value.limit == f"{3 * 1024**3} bytes"
    assert child_of(pool)


@pytest.mark.parametrize("data", [lying_png(), huge_png(), b"", b"no picture", jpeg()[:-400]])
def test_bad_pictures_are_refused_in_the_child_too(pool: DecodePool, data: bytes) -> None:
    with pytest.raises(UnreadableUpload) as caught:
        pool.start(FrameTask(data), known(PlateSearch())).result()
    assert caught.value.field == "file"


def test_more_frames_than_places_are_refused_as_busy() -> None:
    small = DecodePool(slow_decode, workers=1, max_waiting=2)
    small.open()
    try:
        waiting = [start(small, standin.OBEY) for _ in range(2)]
        with pytest.raises(Unavailable, match="busy"):
            start(small, standin.OBEY)
        for pending in waiting:
            pending.result()
        start(small, standin.OBEY).result()
    finally:
        small.close()


def test_a_decoder_that_cannot_start_is_unavailable() -> None:
    broken = DecodePool(broken_decode, workers=1)
    for _attempt in range(2):
        with pytest.raises(Unavailable, match="could be started"):
            broken.open()
    assert not broken.is_ready()
    broken.close()


def broken_decode(*_args: object, **_options: object) -> list[object]:
    raise ImportError("no kernels")


def test_the_picture_is_loaded_before_the_search_is_known(pool: DecodePool) -> None:
    search: Future[PlateSearch] = Future()
    pending = pool.start(FrameTask(png(standin.frame_that(standin.OBEY))), search)
    time.sleep(0.2)
    assert not pending.future.done()
    search.set_result(PlateSearch(codebook=(CODE,)))
    assert pending.result().readings[0].digits == CODE.digits


@pytest.mark.parametrize("data", [png(standin.frame_that(standin.OBEY)), b"no picture"])
def test_a_frame_cancelled_before_its_search_is_known_leaves_nothing_behind(pool: DecodePool, data: bytes) -> None:
    before = [pool.start(FrameTask(data), Future()) for _ in range(4)]
    time.sleep(0.2)
    for pending in before:
        pending.cancel()
    for pending in before:
        with pytest.raises(Unavailable):
            pending.result()
    assert start(pool, standin.OBEY).result().readings[0].digits == CODE.digits


def test_a_killed_idle_process_is_replaced_before_a_frame_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keeper, "_CHECK_S", 3.0)
    made = DecodePool(standin.decode, workers=1)
    assert made.is_ready()
    made.open()
    try:
        victim = child_of(made)
        os.kill(victim, signal.SIGKILL)
        os.waitid(os.P_PID, victim, os.WEXITED | os.WNOWAIT)
        assert not made.is_ready()
        deadline = time.monotonic() + 20
        while not made.is_ready():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert child_of(made) != victim
    finally:
        made.close()
    assert not made.is_ready()


def test_a_cancelled_frame_that_waits_never_runs() -> None:
    made = DecodePool(slow_decode, workers=1, max_waiting=2)
    made.open()
    try:
        running, waiting = start(made, standin.OBEY), start(made, standin.DIE)
        waiting.cancel()
        start(made, standin.OBEY).cancel()  # its place is free again
        with pytest.raises(Unavailable):
            waiting.result()
        pid = int(running.result().readings[0].reason)
        assert int(start(made, standin.OBEY).result().readings[0].reason) == pid
    finally:
        made.close()


def test_a_closed_pool_leaves_no_process_and_takes_no_frame() -> None:
    made = DecodePool(standin.decode, workers=1)
    made.open()
    child = int(start(made, standin.OBEY).result().readings[0].reason.split()[0])
    made.close()
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)
    with pytest.raises(Unavailable):
        start(made, standin.OBEY)


def test_closing_the_pool_ends_the_waiting_for_its_frames() -> None:
    made = DecodePool(standin.decode, workers=1, limits=ChildLimits(timeout_s=60))
    made.open()
    running, queued = start(made, standin.SLEEP), start(made, standin.OBEY)
    threading.Timer(0.3, made.close).start()
    began = time.monotonic()
    for pending in (running, queued):
        with pytest.raises(Unavailable):
            pending.result()
    assert time.monotonic() - began < 10


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_annotation(pool: DecodePool, suffix: str) -> None:
    import cv2
    import numpy as np

    frame = np.full((240, 320, 3), 128, np.uint8)
    outline = Outline(((100, 100), (200, 100), (200, 180), (100, 180)), "read", "023792168411 99 %")
    far = Outline(((-1e9, 0), (10, 0), (10, 1e9), (0, 10)), "unsure", "?")
    drawn = pool.annotate(AnnotationTask(jpeg(frame), (outline, far), suffix))
    assert drawn.startswith({"png": b"\x89PNG", "jpg": b"\xff\xd8"}[suffix])
    pixels = cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_COLOR)
    assert pixels.shape == (240, 320, 3)
    blue, green, red = (int(v) for v in pixels[100, 150])
    assert green > blue + 40
    assert green > red + 40
    assert abs(int(pixels[140, 150, 1]) - 128) < 8
