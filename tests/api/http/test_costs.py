"""Budgets of processor time, slots for expensive requests, and work that stops when nobody waits for it."""

from __future__ import annotations

import asyncio
import os
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import pytest
from starlette.types import Message

from app.api.http.limits import MAX_WAITING, Budget, RateLimit, Slots, admitted, bounded
from app.errors import ClientLeft, TooManyRequests, Unavailable
from app.jobs.pool import Pending
from app.registry.database import Database
from app.services.access.access import Caller, Scope
from app.services.request_work import RequestWork, check_deadline, counted_steps, working
from app.settings import Settings
from tests.conftest import ADMIN_KEY, LiveServer
from tests.http import WITHIN_S, refused

CALLER = Caller("agency", "key", "label", Scope.ADMIN)


async def _nothing() -> Message:
    await asyncio.Event().wait()
    raise AssertionError


async def _leaves() -> Message:
    return {"type": "http.disconnect"}


def _spin(processor_s: float = 0.02) -> None:
    end_s = time.thread_time() + processor_s
    while time.thread_time() < end_s:
        pass


# --- slots --------------------------------------------------------------------------------------------------------


def test_an_agency_waits_for_its_own_requests_only() -> None:
    async def run() -> None:
        slots = Slots(3, 2)
        order: list[str] = []

        async def request(agency: str, name: str, finished: asyncio.Event) -> None:
            async with slots.slot(agency):
                order.append(name)
                await finished.wait()

        ends = {name: asyncio.Event() for name in ("a1", "a2", "a3", "b1", "c1")}
        async with asyncio.TaskGroup() as tasks:
            for name, end in ends.items():
                tasks.create_task(request(name[0], name, end))
                await asyncio.sleep(0)
            assert order == ["a1", "a2", "b1"]
            ends["a1"].set()
            while len(order) < 4:
                await asyncio.sleep(0)
            for end in ends.values():
                end.set()
        assert sorted(order) == sorted(ends)

    asyncio.run(run())


@pytest.mark.parametrize(("wait_s", "waiting"), [(0.001, 1), (60.0, MAX_WAITING + 1)])
def test_too_many_or_too_long_waiting_requests_are_refused(wait_s: float, waiting: int) -> None:
    async def run() -> None:
        slots = Slots(4, 1, wait_s)

        async def wait() -> None:
            async with slots.slot("a"):
                raise AssertionError

        async with slots.slot("a"):
            tasks = [asyncio.create_task(wait()) for _ in range(waiting)]
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            error = done.pop().exception()
            assert isinstance(error, Unavailable)
            assert error.limit == "1 at once for one agency, 4 in all"
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        async with slots.slot("a"):  # what was cancelled holds nothing
            pass

    asyncio.run(run())


# --- endpoints ----------------------------------------------------------------------------------------------------


def _run(endpoint: Callable[[], object], receive: Callable[[], Awaitable[Message]], timeout_s: float = 300.0) -> Any:
    async def run() -> Any:
        with admitted(Slots(1, 1), "agency", timeout_s, receive) as work:
            try:
                await bounded(endpoint, expensive=True)()
            except Unavailable as error:
                return error
            return work

    return asyncio.run(run())


def _work_without_end() -> None:
    while True:
        check_deadline()
        time.sleep(0.001)


def test_work_stops_when_the_client_leaves() -> None:
    assert _run(_work_without_end, _leaves).message == "the client has left"


@pytest.mark.parametrize("further", [b"", b"GET /healthz HTTP/1.1\r\nHost: a\r\n\r\n"], ids=["alone", "pipelined"])
def test_requests_end_when_their_clients_leave(fresh_server: LiveServer, further: bytes) -> None:
    """Also where the client sent a further request, which keeps uvicorn from reading the end of the connection."""
    state = fresh_server.app.state
    for use_case, call, path in (
        (state.use_cases.searches, "page", "/v1/markers"),
        (state.use_cases.features, "page", "/ogc/collections/markers/items"),
        (state.use_cases.features, "tile", "/ogc/collections/markers/tiles/WebMercatorQuad/0/0/0"),
        (state.use_cases.snapshots, "make", "/v1/snapshots?bbox=8,48,9,50"),
        (state.use_cases.exports, "stream", "/v1/exports/csv"),
    ):
        endless = _Endless(state.database)
        setattr(use_case, call, endless)
        request = f"GET {path} HTTP/1.1\r\nHost: a\r\nX-API-Key: {ADMIN_KEY}\r\n\r\n".encode()
        with socket.create_connection(("127.0.0.1", int(fresh_server.url.rpartition(":")[2]))) as client:
            client.sendall(request)
            assert endless.started.wait(WITHIN_S)
            client.sendall(further)
            client.settimeout(0.4)
            with pytest.raises(TimeoutError):  # while the client waits, the work goes on
                client.recv(1)
            assert not endless.ended.is_set()
        assert endless.ended.wait(WITHIN_S), path


def test_a_response_that_nobody_reads_ends_without_a_line_in_the_log(
    fresh_server: LiveServer, caplog: pytest.LogCaptureFixture
) -> None:
    ended = threading.Event()

    def chunks(*_arguments: object) -> Iterator[bytes]:
        yield b"x"
        try:
            _work_without_end()
        finally:
            ended.set()

    fresh_server.app.state.use_cases.exports.stream = chunks
    with (
        fresh_server.client() as client,
        client.stream("GET", "/v1/exports/csv", headers={"Accept-Encoding": "identity"}) as response,
    ):
        assert next(response.iter_raw()) == b"x"
    assert ended.wait(WITHIN_S)
    fresh_server.__exit__()
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []


class _Endless:
    """A use case that asks the database for what it never finds."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self.started, self.ended = threading.Event(), threading.Event()

    def __call__(self, *_arguments: object, **_options: object) -> None:
        try:
            with self._database.read() as connection:
                self.started.set()
                connection.exec_driver_sql(
                    "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT count(*) FROM n"
                ).all()
        except ClientLeft:
            self.ended.set()
            raise


def test_work_stops_at_its_deadline() -> None:
    assert "too long" in _run(_work_without_end, _nothing, timeout_s=0.01).message


def test_the_processor_time_of_threads_and_streams_is_counted() -> None:
    work = _run(_spin, _nothing)
    assert isinstance(work, RequestWork)
    assert work.used_s >= 0.02

    def chunks() -> Iterator[int]:
        for number in range(3):
            _spin()
            yield number

    with working(60.0) as work:
        assert list(counted_steps(chunks())) == [0, 1, 2]
    assert work.used_s >= 0.06


def test_a_task_of_a_client_that_left_is_cancelled() -> None:
    interrupted: list[object] = []
    pending: Pending[int] = Pending(os.getpid, (), interrupted.append, 60.0)
    assert pending.future.set_running_or_notify_cancel()
    pending.used_s = 1.5
    with working(60.0) as work:
        work.stops.stop()
        with pytest.raises(Unavailable):
            pending.result()
    assert interrupted == [pending]
    assert work.used_s == 1.5


# --- budgets ------------------------------------------------------------------------------------------------------


def test_a_budget_is_charged_afterwards_and_may_be_overdrawn() -> None:
    now_s = [1000.0]
    limit = RateLimit(2.0, 10, name="x", message="x", cure="x", now_s=lambda: now_s[0])
    limit.charge("a", 9.0)
    limit.check("a")
    limit.charge("a", 21.0)
    with pytest.raises(TooManyRequests) as error:
        limit.check("a")
    assert error.value.retry_after_s == 11
    limit.check("b")
    now_s[0] += 10.5
    limit.check("a")


def test_keys_share_the_budget_of_their_agency() -> None:
    budget = Budget(0.0, 1.0)
    budget.charge(CALLER, 100.0)
    with pytest.raises(TooManyRequests, match="this agency used too much"):
        budget.check(Caller("agency", "another key", "label", Scope.ADMIN))
    budget.check(Caller("another agency", "another key", "label", Scope.ADMIN))
    Budget(0.0, 0.0).charge(CALLER, 1e9)


def test_a_key_that_used_up_its_time_is_refused(serve: Callable[[Settings], LiveServer], settings: Settings) -> None:
    server = serve(settings.model_copy(update={"key_processor_s_per_min": 1e-3}))
    with server.client() as client:
        assert client.get("/v1/markers").status_code == 200
        refusal = client.get("/v1/markers")
        problem = refused(refusal, 429, "too-many-requests")
        assert int(refusal.headers["Retry-After"]) >= 1
        assert "processor time" in problem["detail"]
        assert client.get("/healthz").status_code == 200


def test_a_job_is_charged_to_its_agency_and_to_no_key() -> None:
    budget = Budget(key_s_per_min=60.0, agency_s_per_min=120.0)
    budget.charge_job("agency", 1000.0)
    budget.check(CALLER)
    budget.charge_job("agency", 1000.0)
    with pytest.raises(TooManyRequests, match="the requests of this agency"):
        budget.check(CALLER)
    budget.check(Caller("another", "key", "label", Scope.ADMIN))
