"""Decoder processes: real ones, really killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from functools import partial
from pathlib import Path

import psutil
import pytest

from app.decoding.frames import PlateSearch
from app.errors import InvalidParameter, ProcessStopped, Unavailable, UnreadableUpload
from app.formats.format import SpooledFile
from app.jobs import decoder_process
from app.jobs import pool as supervisor
from app.jobs.decoder_process import ProcessLimits
from app.jobs.pool import DecodePool, Pending, WorkerSupervisor
from app.markers.plate import PlateCode
from app.markers.reading import PlateOutcome
from app.plots.annotated_frame import Outline
from app.registry.engines import acting_for
from app.services.decodes.frame_tasks import (
    FramePicture,
    FrameResult,
    FrameSearch,
    annotate_frame,
    decode_frame,
)
from tests.formats.pictures import huge_png, jpeg, lying_png, png
from tests.http import wait_until
from tests.jobs import standin

CODE = PlateCode.from_position(8.5, 49.0)


@pytest.fixture(scope="module")
def pool() -> Iterator[DecodePool]:
    made = DecodePool(standin.decode, workers=2)
    made.open()
    yield made
    made.close()


def known(search: PlateSearch) -> Future[FrameSearch]:
    future: Future[FrameSearch] = Future()
    future.set_result({"plate": search})
    return future


def start(pool: DecodePool, what: int) -> Pending[FrameResult]:
    return submit(pool, png(standin.frame_that(what)), known(PlateSearch(codebook=(CODE,))))


def submit(pool: DecodePool, data: bytes, search: Future[FrameSearch]) -> Pending[FrameResult]:
    return pool.submit(decode_frame, FramePicture(SpooledFile.of(data)), search)


def child_of(pool: DecodePool) -> int:
    return int(start(pool, standin.OBEY).result().readings[0].reason.split()[0])


def is_gone(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def wait_for_held(folder: Path) -> int:
    """Id of the only process that holds a frame (`standin.hold`)."""
    [path] = wait_until(lambda: list(folder.glob("*.pid")), "a process to hold a frame")
    path.unlink()
    return int(path.stem)


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
    with pytest.raises(UnreadableUpload, match="interrupted: the decoder process ended"):
        bad.result()
    assert [p.result().readings[0].digits for p in more] == [CODE.digits] * 4


def test_killing_idle_processes_costs_no_frame(pool: DecodePool) -> None:
    for wait_for_the_end in (False, True):
        victim = child_of(pool)
        os.kill(victim, signal.SIGKILL)
        if wait_for_the_end:
            wait_until(lambda: is_gone(victim), "the process to end")  # noqa: B023 - asked in this round only
        assert start(pool, standin.OBEY).result().readings[0].digits == CODE.digits


def test_a_process_killed_from_outside_is_tried_again(tmp_path: Path) -> None:
    """An out-of-memory killer takes a child in the middle of somebody's good frame."""
    made = DecodePool(partial(standin.hold, tmp_path), workers=1, limits=ProcessLimits(timeout_s=600))
    made.open()
    try:
        pending = start(made, standin.OBEY)
        victim = wait_for_held(tmp_path)
        os.kill(victim, signal.SIGKILL)
        (tmp_path / "go").touch()
        assert int(pending.result().readings[0].reason.split()[0]) != victim
    finally:
        made.close()


@pytest.mark.slow
def test_the_process_that_the_others_are_forks_of_is_replaced_too() -> None:
    made = DecodePool(standin.decode, workers=1)
    made.open()
    try:
        victim = child_of(made)
        os.kill(psutil.Process(victim).ppid(), signal.SIGKILL)
        assert child_of(made)
        wait_until(lambda: is_gone(victim), "the process without a parent to end")
        assert child_of(made) != victim
    finally:
        made.close()


SERVER = """
import sys
from app.jobs.pool import DecodePool
from tests.formats.pictures import png
from tests.jobs import standin
from tests.jobs.test_pool import PlateSearch, known, start

pool = DecodePool(standin.decode, workers=1)
pool.open()
pending = start(pool, standin.SLEEP)
print("decoding", flush=True)
pending.result()
"""


@pytest.mark.slow
def test_no_process_outlives_a_server_that_is_killed_while_it_decodes() -> None:
    with subprocess.Popen([sys.executable, "-c", SERVER], stdout=subprocess.PIPE) as server:
        assert server.stdout is not None
        assert server.stdout.readline() == b"decoding\n"
        children = psutil.Process(server.pid).children(recursive=True)
        assert len(children) >= 2
        server.kill()
        wait_until(lambda: all(is_gone(child.pid) for child in children), "the server's processes to end")


def test_the_process_that_imports_the_decoders_ends_with_the_server() -> None:
    program = (
        "import time\nfrom app.jobs.forkserver_preload import end_with_parent\nend_with_parent()\n"
        "print(flush=True)\ntime.sleep(3600)"
    )
    parent = f"import subprocess, sys\nsubprocess.Popen([sys.executable, '-c', {program!r}]).wait()"
    with subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE) as server:
        assert server.stdout is not None
        server.stdout.readline()
        [child] = psutil.Process(server.pid).children()
        server.kill()
        wait_until(lambda: is_gone(child.pid), "the child to end")


def test_the_process_that_decoder_processes_are_forks_of_has_one_thread(pool: DecodePool) -> None:
    """A fork has none of the other threads, but the locks that they hold."""
    forked = psutil.Process(child_of(pool)).parent()
    assert forked is not None
    assert forked.num_threads() == 1


@pytest.mark.slow
def test_decoders_and_their_kernels_are_loaded_before_a_process_is_forked() -> None:
    """Else each decoder process has its own 90 MB of them; the collector would copy them, page by page."""
    program = (
        "import gc, os\nfrom app.jobs.forkserver_preload import load_decoders\nload_decoders()\n"
        "from app.decoders.plate.fit import minimize\n"
        "print(len(minimize.signatures) > 0, gc.get_freeze_count() > 100_000, gc.isenabled(),"
        " len(os.listdir('/proc/self/task')))"
    )
    environment = os.environ | decoder_process.ONE_THREAD
    run = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["True", "True", "True", "1"]


def test_a_frame_that_takes_too_long_is_stopped() -> None:
    made = DecodePool(standin.decode, workers=1, limits=ProcessLimits(timeout_s=2.0))
    made.open()
    try:
        began = time.monotonic()
        with pytest.raises(UnreadableUpload, match="too long") as caught:
            start(made, standin.SLEEP).result()
        assert time.monotonic() - began > 1.9
        assert caught.value.limit == "2 s a file"
        assert child_of(made)
    finally:
        made.close()


def test_a_running_frame_can_be_cancelled(tmp_path: Path) -> None:
    made = DecodePool(partial(standin.hold, tmp_path), workers=1, limits=ProcessLimits(timeout_s=600))
    made.open()
    try:
        pending = start(made, standin.OBEY)
        victim = wait_for_held(tmp_path)
        threading.Thread(target=pending.cancel).start()
        with pytest.raises(Unavailable):  # one that exceeds its time ends as UnreadableUpload, above
            pending.result()
        (tmp_path / "go").touch()
        assert child_of(made) != victim
    finally:
        made.close()


@pytest.mark.parametrize("what", [standin.NO_THREAD, standin.NO_MEMORY])
def test_a_process_that_ran_short_is_replaced_and_the_frame_tried_once_more(tmp_path: Path, what: int) -> None:
    """What fills a process need not be the frame at which it shows: that one is read, and so is the next."""
    made = DecodePool(partial(standin.run_short_once, tmp_path), workers=1)
    made.open()
    try:
        first = child_of(made)
        assert start(made, what).result().readings[0].digits == CODE.digits
        assert made.describe().starts == 2
        assert child_of(made) != first
        (tmp_path / "short").unlink()
        (tmp_path / "always").touch()
        with pytest.raises(ProcessStopped, match="more memory"):
            start(made, what).result()
        (tmp_path / "always").unlink()
        assert start(made, standin.OBEY).result().readings[0].digits == CODE.digits
        assert made.describe().starts == 4
    finally:
        made.close()


def test_memory_has_a_limit(pool: DecodePool) -> None:
    with pytest.raises(UnreadableUpload, match="more memory") as caught:
        start(pool, standin.HOG).result()
    assert caught.value.limit == f"{ProcessLimits().memory_bytes} bytes"
    assert child_of(pool)


@pytest.mark.parametrize("data", [lying_png(), huge_png(), b"", b"no picture", jpeg()[:-400]])
def test_bad_pictures_are_refused_in_the_child_too(pool: DecodePool, data: bytes) -> None:
    with pytest.raises(UnreadableUpload) as caught:
        submit(pool, data, known(PlateSearch())).result()
    assert caught.value.field == "file"


def test_more_frames_than_places_are_refused_as_busy(tmp_path: Path) -> None:
    small = DecodePool(partial(standin.hold, tmp_path), workers=1, max_waiting=2)
    small.open()
    try:
        waiting = [start(small, standin.OBEY) for _ in range(2)]
        with pytest.raises(Unavailable, match="busy"):
            start(small, standin.OBEY)
        (tmp_path / "go").touch()
        for pending in waiting:
            pending.result()
        start(small, standin.OBEY).result()
    finally:
        small.close()


def test_an_agency_that_takes_every_place_keeps_no_other_from_its_own(tmp_path: Path) -> None:
    small = DecodePool(partial(standin.hold, tmp_path), workers=1, max_waiting=3)
    small.open()
    try:
        with acting_for("one"):
            waiting = [start(small, standin.OBEY) for _ in range(3)]
            with pytest.raises(Unavailable, match="3 tasks of this agency"):
                start(small, standin.OBEY)
        with acting_for("two"):
            waiting.append(start(small, standin.OBEY))
        ended: list[int] = []
        for number, pending in enumerate(waiting):
            pending.future.add_done_callback(lambda _future, number=number: ended.append(number))
        (tmp_path / "go").touch()
        for pending in waiting:
            pending.result()
        assert ended == [0, 3, 1, 2]
    finally:
        small.close()


@pytest.mark.slow
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
    search: Future[FrameSearch] = Future()
    pending = submit(pool, png(standin.frame_that(standin.OBEY)), search)
    wait_until(pending.future.running, "a process to take the picture")
    assert not pending.future.done()
    search.set_result({"plate": PlateSearch(codebook=(CODE,))})
    assert pending.result().readings[0].digits == CODE.digits


@pytest.mark.parametrize("data", [png(standin.frame_that(standin.OBEY)), b"no picture"])
def test_a_frame_cancelled_before_its_search_is_known_leaves_nothing_behind(pool: DecodePool, data: bytes) -> None:
    before = [submit(pool, data, Future()) for _ in range(4)]
    wait_until(lambda: sum(pending.future.running() for pending in before) == 2, "both processes to take a picture")
    for pending in before:
        pending.cancel()
    for pending in before:
        with pytest.raises(Unavailable):
            pending.result()
    assert start(pool, standin.OBEY).result().readings[0].digits == CODE.digits


def test_a_killed_idle_process_is_replaced_before_a_frame_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    may_replace = threading.Event()
    start_early = WorkerSupervisor._start_early

    def start_when_allowed(self: WorkerSupervisor) -> None:
        if may_replace.is_set():
            start_early(self)

    monkeypatch.setattr(WorkerSupervisor, "_start_early", start_when_allowed)
    monkeypatch.setattr(supervisor, "_CHECK_S", 0.05)
    made = DecodePool(standin.decode, workers=1)
    assert made.is_ready()
    made.open()
    try:
        victim = child_of(made)
        os.kill(victim, signal.SIGKILL)
        wait_until(lambda: not made.is_ready(), "the end of the process to be noticed")
        may_replace.set()
        wait_until(made.is_ready, "the process to be replaced")
        assert child_of(made) != victim
    finally:
        made.close()
    assert not made.is_ready()


def test_a_cancelled_frame_that_waits_never_runs(tmp_path: Path) -> None:
    made = DecodePool(partial(standin.hold, tmp_path), workers=1, max_waiting=2)
    made.open()
    try:
        running, waiting = start(made, standin.OBEY), start(made, standin.DIE)
        pid = wait_for_held(tmp_path)
        waiting.cancel()
        start(made, standin.OBEY).cancel()  # its place is free again
        with pytest.raises(Unavailable):
            waiting.result()
        (tmp_path / "go").touch()
        assert running.result().readings[0].digits == CODE.digits
        assert child_of(made) == pid
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
    made = DecodePool(standin.decode, workers=1, limits=ProcessLimits(timeout_s=600))
    made.open()
    running, queued = start(made, standin.SLEEP), start(made, standin.OBEY)
    wait_until(running.future.running, "the frame to run")
    threading.Thread(target=made.close).start()
    for pending in (running, queued):
        with pytest.raises(Unavailable):
            pending.result()


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_annotation(pool: DecodePool, suffix: str) -> None:
    import cv2
    import numpy as np

    frame = np.full((240, 320, 3), 128, np.uint8)
    outline = Outline(((100, 100), (200, 100), (200, 180), (100, 180)), "read", "023792168411 99 %")
    far = Outline(((-1e9, 0), (10, 0), (10, 1e9), (0, 10)), "unsure", "?")
    drawn = pool.run(annotate_frame, FramePicture(SpooledFile.of(jpeg(frame))), (outline, far), suffix)
    assert drawn.startswith({"png": b"\x89PNG", "jpg": b"\xff\xd8"}[suffix])
    pixels = cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_COLOR)
    assert pixels.shape == (240, 320, 3)
    blue, green, red = (int(v) for v in pixels[100, 150])
    assert green > blue + 40
    assert green > red + 40
    assert abs(int(pixels[140, 150, 1]) - 128) < 8
