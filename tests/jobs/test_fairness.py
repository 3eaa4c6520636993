"""One agency's thousand jobs or tasks do not hold up another's: turns in queues, places before decoder processes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from queue import Empty

import pytest

from app.errors import Unavailable
from app.jobs.pool import Places
from app.jobs.queues import FairQueue, LocalQueue
from app.registry.engines import EVERY_AGENCY
from app.registry.jobs import JobKind, UnfinishedJob
from app.services.jobs import QUEUES
from app.services.request_work import add_processor_time
from tests.http import WITHIN_S, wait_until


def test_owners_are_served_in_turn_each_in_its_order() -> None:
    queue: FairQueue[str] = FairQueue()
    for number in range(4):
        queue.put("a", f"a{number}")
    queue.put("b", "b0")
    queue.put("b", "b1")
    assert [queue.get() for _ in range(3)] == ["a0", "b0", "a1"]
    queue.put("c", "c0")  # has had no turn yet
    assert [queue.get() for _ in range(4)] == ["c0", "b1", "a2", "a3"]
    with pytest.raises(Empty):
        queue.get(0.0)


def test_the_owner_that_used_least_lately_is_next() -> None:
    now_s = 0.0
    queue: FairQueue[str] = FairQueue(now_s=lambda: now_s)
    for number in range(3):
        queue.put("a", f"a{number}")
        queue.put("b", f"b{number}")
    assert queue.get() == "a0"
    queue.done("a", 10.0)
    for expected in ("b0", "b1"):  # 4 and 8 s are less than 10
        assert queue.get() == expected
        queue.done("b", 4.0)
    assert queue.get() == "b2"
    queue.done("b", 4.0)
    assert queue.get() == "a1"
    queue.put("c", "c0")
    assert queue.get() == "c0"
    queue.done("c", 1.0)
    now_s = 3600.0  # what was used an hour ago counts no more than the last turn
    queue.put("c", "c1")
    queue.done("a", 0.5)
    assert queue.get() == "c1"


def test_jobs_of_an_owner_leave_room_for_others_that_were_there_lately() -> None:
    now_s = 0.0
    queue: FairQueue[str] = FairQueue(jobs_at_once=1, now_s=lambda: now_s)
    for number in range(4):
        queue.put("a", f"a{number}", is_job=True)
    assert [queue.get(), queue.get()] == ["a0", "a1"]  # nobody else is there
    queue.put("b", "b0", is_job=True)
    assert queue.get() == "b0"
    queue.done("b", is_job=True)
    queue.done("a", is_job=True)
    with pytest.raises(Empty):
        queue.get(0.0)  # one of a's jobs runs, and b was there
    queue.put("a", "at once")
    assert queue.get() == "at once"  # what a client waits for is no job
    queue.done("a")
    now_s = 4000.0
    assert queue.get() == "a2"


def test_work_of_the_server_itself_is_no_other_owner() -> None:
    queue: FairQueue[str] = FairQueue(jobs_at_once=1)
    for owner in ("", EVERY_AGENCY):
        queue.put(owner, owner)
        queue.get()
    queue.put("a", "a0", is_job=True)
    queue.put("a", "a1", is_job=True)
    assert [queue.get(0.0), queue.get(0.0)] == ["a0", "a1"]


def test_the_time_of_jobs_that_somebody_waits_for_is_charged_to_their_agency() -> None:
    charged: dict[str, float] = {}
    ended = threading.Event()
    jobs = LocalQueue()
    jobs.charge = charged.__setitem__
    jobs.open(Run(lambda job_id: add_processor_time(7.0) if job_id == "video" else ended.set()))
    try:
        jobs.submit("proof", "one", JobKind.PROOF)
        jobs.submit("video", "two", JobKind.DECODE)
        wait_until(lambda: "two" in charged, "the charge")
        assert ended.wait(WITHIN_S)
    finally:
        jobs.close()
    assert list(charged) == ["two"]
    assert charged["two"] >= 7.0


def test_a_closed_queue_ends_when_it_is_empty() -> None:
    queue: FairQueue[str] = FairQueue()
    queue.put("a", "a0")
    queue.close()
    assert [queue.get(), queue.get(), queue.get()] == ["a0", None, None]


def test_an_owner_without_a_name_is_one_like_the_others() -> None:
    queue: FairQueue[str] = FairQueue()
    for item in ("first", "second"):
        queue.put("", item)
    assert [queue.get(), queue.get()] == ["first", "second"]


@dataclass
class Run:
    """Runs jobs that are in no database."""

    run: Callable[[str], None]
    startable: list[UnfinishedJob] = field(default_factory=list)

    def run_job(self, job_id: str) -> bool:
        self.run(job_id)
        return True

    def list_startable(self) -> list[UnfinishedJob]:
        return self.startable


@pytest.mark.parametrize("at_start", [False, True], ids=["submitted", "unfinished at the start"])
def test_a_job_runs_beside_that_of_another_agency_which_has_a_thousand_waiting(at_start: bool) -> None:
    ran: list[str] = []
    may_go_on, first, second = threading.Event(), threading.Event(), threading.Event()

    def run(job_id: str) -> None:
        ran.append(job_id)
        if job_id == "other":
            second.set()
        else:
            first.set()
            assert may_go_on.wait(WITHIN_S)

    many = [UnfinishedJob(f"one {number}", "one", JobKind.DECODE) for number in range(1000)]
    jobs = LocalQueue()
    jobs.open(Run(run, [*many, UnfinishedJob("other", "two", JobKind.DECODE)] if at_start else many))
    try:
        assert first.wait(WITHIN_S)
        if not at_start:
            jobs.submit("other", "two", JobKind.DECODE)
        assert second.wait(WITHIN_S)
        assert sorted(ran) == ["one 0", "other"]  # one of each agency, though the first one still runs
        may_go_on.set()
    finally:
        jobs.close()


def test_an_agency_alone_has_all_places_and_beside_another_half() -> None:
    places = Places(8)
    for _ in range(8):
        places.take("one")
    with pytest.raises(Unavailable, match="8 tasks of this agency") as caught:
        places.take("one")
    assert caught.value.limit == "8 tasks, and 4 of one agency while others send some"
    places.take("two")  # certain, though all places are taken
    for _ in range(3):
        places.give_back("one")
    with pytest.raises(Unavailable):
        places.take("one")  # five of eight, and another sends too
    for _ in range(2):
        places.take("two")
    places.give_back("one")
    places.give_back("one")
    places.take("one")
    with pytest.raises(Unavailable):
        places.take("one")


def test_a_place_that_is_given_back_goes_to_who_waits_for_it() -> None:
    places = Places(2)
    for _ in range(2):
        places.take(EVERY_AGENCY)
    taken = threading.Event()

    def wait() -> None:
        places.take(EVERY_AGENCY, WITHIN_S)
        taken.set()

    threading.Thread(target=wait, daemon=True).start()
    with pytest.raises(Unavailable):
        places.take(EVERY_AGENCY)
    places.give_back(EVERY_AGENCY)
    assert taken.wait(WITHIN_S)
    with pytest.raises(Unavailable):
        places.take(EVERY_AGENCY)


def test_every_kind_of_job_has_a_queue_and_a_proof_holds_up_neither_a_plan_nor_an_upload() -> None:
    assert QUEUES.keys() == set(JobKind)
    ran: set[str] = set()
    proof_started, others_ran = threading.Event(), threading.Event()

    def run(job_id: str) -> None:
        if job_id == JobKind.PROOF:
            proof_started.set()
            assert others_ran.wait(WITHIN_S)
        ran.add(job_id)
        if ran == set(JobKind) - {JobKind.PROOF}:
            others_ran.set()

    jobs = LocalQueue()
    jobs.open(Run(run))
    try:
        jobs.submit(JobKind.PROOF, "one", JobKind.PROOF)
        assert proof_started.wait(WITHIN_S)
        for kind in set(JobKind) - {JobKind.PROOF}:
            jobs.submit(kind, "one", kind)
        assert others_ran.wait(WITHIN_S)
    finally:
        jobs.close()
