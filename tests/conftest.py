"""Fixtures that every test may use: a real server on a real socket over a real database file."""

from __future__ import annotations

import functools
import itertools
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import hypothesis
import pytest
import sqlalchemy as sa
import structlog
import uvicorn
from fastapi import FastAPI

from app.api.http.connections import ConnectionLimits, limited_connections
from app.decoders.plate.reader import decode_plates
from app.decoding.frames import DecodePlates
from app.jobs import queues
from app.main import create_app
from app.markers.reading import MarkerRow
from app.registry.column_types import row_of
from app.registry.database import Database
from app.registry.engines import across_agencies
from app.registry.features import feature_text
from app.registry.marker_rows import markers
from app.services.access.access import Scope
from app.settings import Settings
from app.worker import running_worker
from tests import machine
from tests.brokers import delete_all_queues, find_broker, own_queues
from tests.databases import PostgresServer, postgres_server
from tests.documented import DEVIATIONS, CheckedResponses
from tests.http import WITHIN_S

hypothesis.settings.register_profile("repeatable", derandomize=True)  # on CI it is so; searches are benchmarks
hypothesis.settings.load_profile("repeatable")
ADMIN_KEY = "an-admin-key-for-tests-only"
UNLIMITED: dict[str, Any] = {
    "requests_per_s": 0.0,
    "wrong_keys_per_minute": 0.0,
    "public_pages_per_minute": 0.0,
    "damage_reports_per_hour": 0.0,
    "marker_reports_per_day": 0.0,
}
"""Settings of servers that tests ask faster than a key may."""
Place = Callable[[], dict[str, Any]]
"""The fixture `place`."""


@functools.cache
def migrated_database() -> bytes:
    """An SQLite file with the current schema and no rows: migrations take half a second, a copy does not."""
    with TemporaryDirectory() as folder:
        database = Database(f"sqlite:///{folder}/waymark.sqlite3")
        database.migrate()
        database.close()  # which moves the write-ahead log into the file
        return Path(folder, "waymark.sqlite3").read_bytes()


class LiveServer:
    """An app behind uvicorn in a thread of this process, over a migrated SQLite file if there is none."""

    def __init__(self, app: FastAPI) -> None:
        self.app = app
        config = uvicorn.Config(
            CheckedResponses(app), host="127.0.0.1", port=0, http=limited_connections(ConnectionLimits()), ws="none",
            log_config=None, access_log=False, lifespan="on",
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, daemon=True)

    def __enter__(self) -> LiveServer:
        if (path := self.app.state.database.path) is not None and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(migrated_database())
        self._thread.start()
        deadline = time.monotonic() + WITHIN_S
        while not self._server.started:
            assert self._thread.is_alive(), "the server did not start"
            assert time.monotonic() < deadline, "the server did not start in time"
            time.sleep(0.005)
        port = self._server.servers[0].sockets[0].getsockname()[1]
        self.url = f"http://127.0.0.1:{port}"
        return self

    def __exit__(self, *_: object) -> None:
        try:
            if self._thread.is_alive():  # a test may have stopped it
                self.check_features()
        finally:
            self._server.should_exit = True
            self._thread.join(WITHIN_S)
            assert not self._thread.is_alive(), "the server did not stop"

    def check_features(self) -> None:
        """Whatever a test did: the feature that is kept beside a marker is that of its columns."""
        with across_agencies(), self.app.state.database.read() as connection:
            for row in connection.execute(sa.select(markers).limit(5000)).mappings():
                assert row["feature"] == feature_text(row_of(MarkerRow, row))

    def client(self, key: str | None = ADMIN_KEY) -> httpx.Client:
        """A client that sends a key."""
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        return httpx.Client(base_url=self.url, headers=headers, timeout=WITHIN_S, trust_env=False)

    def agency(self, name: str, scope: Scope = Scope.PLANNER) -> httpx.Client:
        """A client of an agency, which is created if need be."""
        return self.client(self.app.state.use_cases.access.create_key(name, scope, label=f"{name} {scope}"))


@contextmanager
def serving(settings: Settings, *, decode: DecodePlates = decode_plates) -> Iterator[LiveServer]:
    """A server, and a worker if the settings have a broker."""
    with LiveServer(create_app(settings, decode=decode)) as running, ExitStack() as stack:
        if settings.broker_url:
            worker = stack.enter_context(running_worker(settings, decode=decode))
            assert worker.wait_until_ready(WITHIN_S), "the worker did not start"
        yield running


@pytest.fixture(scope="session")
def postgres() -> Iterator[PostgresServer]:
    """A PostgreSQL server to make databases on."""
    with postgres_server() as server:
        yield server


@pytest.fixture(scope="session")
def require_tool() -> Callable[..., str]:
    """Path of a program; without it the test is skipped, on CI it fails."""
    return machine.require_tool


@pytest.fixture(scope="session", autouse=True)
def _operator() -> Iterator[None]:
    """Tests that open a database themselves see the rows of all agencies; servers run in threads, which do not."""
    with across_agencies():
        yield


@pytest.fixture(scope="session", autouse=True)
def _short_tracebacks() -> None:
    """Log tracebacks as servers do (app/logs.py): structlog's default shows local variables, which takes seconds."""
    plain = structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback)
    structlog.configure(processors=[*structlog.get_config()["processors"][:-1], plain])


@pytest.fixture(autouse=True)
def _responses_are_documented() -> Iterator[None]:
    """Every response that the servers sent during a test is as the OpenAPI document says."""
    yield
    deviations = list(dict.fromkeys(DEVIATIONS))
    DEVIATIONS.clear()
    assert deviations == [], "responses deviate from the OpenAPI document"


@pytest.fixture(scope="module")
def backend() -> str:
    """The kind of database that the tests of a module run on; the marker `both_databases` runs them on both."""
    return "sqlite"


@pytest.fixture(scope="module")
def engine() -> str:
    """What runs the jobs of the tests of a module; the marker `both_engines` runs them on both."""
    return "embedded"


@pytest.fixture(scope="module")
def engine_settings(engine: str) -> Iterator[dict[str, Any]]:
    """Settings of the engine, with queues that no other module has."""
    if engine == "embedded":
        yield {}
        return
    broker_url = find_broker()
    with own_queues(broker_url) as prefix:
        yield {"broker_url": broker_url, "broker_prefix": prefix, "blobs_shared": True}


@pytest.fixture(scope="session", autouse=True)
def _no_queues_left() -> Iterator[None]:
    yield
    delete_all_queues()


@pytest.fixture(scope="session", autouse=True)
def _no_resubmission() -> None:
    """Tests put jobs into the database that nothing may run; those about resubmission call it themselves."""
    queues.RESUBMIT_S = 3600.0


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run tests with the marker `both_databases` on each database, with `both_engines` also on both engines."""
    if "engine" in metafunc.fixturenames and metafunc.definition.get_closest_marker("both_engines"):
        both = [("sqlite", "embedded"), ("postgresql", "embedded"), ("postgresql", "celery")]
        metafunc.parametrize(("backend", "engine"), both, scope="module")
        return
    if "backend" in metafunc.fixturenames and metafunc.definition.get_closest_marker("both_databases"):
        metafunc.parametrize("backend", ["sqlite", "postgresql"], scope="module")


_SERVERS = {"postgres", "browser", "broker"}
"""Fixtures of what a machine has only if somebody installed it."""


_LONG = {"web", "test_no_server_errors.py"}
"""Folders and files of slow tests alone. They are not even read where slow tests are left out: they load much."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Read no file of slow tests alone when slow tests are left out."""
    return True if config.option.markexpr == "not slow" and collection_path.name in _LONG else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what needs a server or a browser as slow, and begin with the files that take longest.

    Processes then end at about the same time. Of many slow tests in a file, most are quick ones on PostgreSQL.
    """
    for item in items:
        parameters = item.callspec.params if isinstance(item, pytest.Function) and hasattr(item, "callspec") else {}
        needs_server = _SERVERS & set(getattr(item, "fixturenames", ())) or parameters.get("backend") == "postgresql"
        if needs_server or _LONG & set(item.path.parts):
            item.add_marker("slow")
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: (not _LONG & set(item.path.parts), slow[item.path] or len(items)))


@pytest.fixture(scope="module")
def new_database_url(backend: str, request: pytest.FixtureRequest) -> Callable[[Path], str]:
    """URLs of empty databases, for each the folder that a file may lie in."""
    if backend == "postgresql":
        server: PostgresServer = request.getfixturevalue("postgres")
        return lambda _folder: server.empty()
    return lambda folder: f"sqlite:///{folder / 'waymark.sqlite3'}"


@pytest.fixture
def settings(tmp_path: Path, new_database_url: Callable[[Path], str]) -> Settings:
    """Settings of a server with an empty folder and an empty database of its own."""
    folder = tmp_path / "var"
    url = new_database_url(folder)
    return Settings(data_dir=folder, database_url=url, admin_key=ADMIN_KEY, warm_decoders=False, **UNLIMITED)


@pytest.fixture
def serve() -> Iterator[Callable[..., LiveServer]]:
    """Start servers with given settings; they stop when the test ends."""
    running: list[LiveServer] = []

    def start(settings: Settings) -> LiveServer:
        running.append(LiveServer(create_app(settings)).__enter__())
        return running[-1]

    yield start
    for server in running:
        server.__exit__()


@pytest.fixture
def fresh_server(serve: Callable[[Settings], LiveServer], settings: Settings) -> LiveServer:
    """A server over an empty database."""
    return serve(settings)


@contextmanager
def verified_server(folder: Path, database_url: str) -> Iterator[LiveServer]:
    """A server whose history is verified at the end."""
    settings = Settings(
        data_dir=folder, database_url=database_url, admin_key=ADMIN_KEY, warm_decoders=False, **UNLIMITED
    )
    with LiveServer(create_app(settings)) as running:
        yield running
        with across_agencies():
            faults = [(name, fault) for name, _, found in running.app.state.use_cases.audit.verify() for fault in found]
        assert faults == [], "what the tests did is not as its history says"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, new_database_url: Callable[[Path], str]) -> Iterator[LiveServer]:
    """A server that the tests of a module share; each test has an agency of its own."""
    folder = tmp_path_factory.mktemp("server") / "var"
    with verified_server(folder, new_database_url(folder)) as running:
        yield running


_AGENCIES = itertools.count(1)


@pytest.fixture
def client(server: LiveServer) -> Iterator[httpx.Client]:
    """A client with the scope `planner` of an agency that only this test uses."""
    with server.agency(f"agency {next(_AGENCIES)}") as agency:
        yield agency


@pytest.fixture
def place() -> Callable[[], dict[str, Any]]:
    """Positions that no other test uses, far from each other."""

    def new_place() -> dict[str, Any]:
        step = next(_PLACES)
        return {"lon_deg": 10.0 + step * 0.731237 % 100, "lat_deg": 20.0 + step * 0.417713 % 40}

    return new_place


_PLACES = itertools.count(1)
