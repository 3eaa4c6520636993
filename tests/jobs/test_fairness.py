"""One agency's thousand jobs or tasks do not hold up another's: turns in queues, places before decoder processes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from queue import Empty

import pytest

from app.errors import Unavailable
from app.jobs.fair_queue import FairQueue
from app.jobs.local_queue import LocalQueue
from app.jobs.places import Places
from app.registry.jobs import JobKind, UnfinishedJob
from app.registry.tenancy import EVERY_AGENCY
from app.services.job_queues import QUEUES
from tests.http import WITHIN_S


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
def test_a_job_waits_for_the_running_one_not_for_a_thousand_of_another_agency(at_start: bool) -> None:
    ran: list[str] = []
    may_go_on, first, second = threading.Event(), threading.Event(), threading.Event()

    def run(job_id: str) -> None:
        ran.append(job_id)
        first.set()
        assert may_go_on.wait(WITHIN_S)
        if job_id == "other":
            second.set()

    many = [UnfinishedJob(f"one {number}", "one", JobKind.DECODE) for number in range(1000)]
    jobs = LocalQueue()
    jobs.open(Run(run, [*many, UnfinishedJob("other", "two", JobKind.DECODE)] if at_start else many))
    try:
        assert first.wait(WITHIN_S)
        if not at_start:
            jobs.submit("other", "two", JobKind.DECODE)
        may_go_on.set()
        assert second.wait(WITHIN_S)
    finally:
        jobs.close()
    assert ran[:2] == ["one 0", "other"]


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
