"""Metrics are right, and the dashboard and the alert rules ask for metrics and labels that a scrape has."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from app.control.metrics import MetricsServer, ProcessMetrics
from app.demo.server import free_ports
from app.errors import Unavailable, UnreadableUpload
from app.main import create_app
from app.registry import jobs as store
from app.registry.engines import across_agencies
from app.registry.jobs import JobKind
from app.services.decodes.upload_path import DECODE_METRICS, measured
from app.services.ports import utc_now
from app.settings import Settings
from tests.conftest import LiveServer
from tests.http import WITHIN_S

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).resolve().parents[2] / "docker/monitoring"
FUNCTIONS = {"rate", "increase", "sum", "max", "min", "histogram_quantile", "by", "on", "and"}
Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def scrape(url: str) -> tuple[Samples, dict[str, set[str]]]:
    """Samples of a scrape, and the names of all series with their labels."""
    samples: Samples = {}
    names: dict[str, set[str]] = {}
    for family in text_string_to_metric_families(httpx.get(f"{url}/metrics", trust_env=False, timeout=WITHIN_S).text):
        endings = {"histogram": ("_bucket", "_sum", "_count"), "counter": ("_total",)}.get(family.type, ("",))
        for ending in endings:
            names.setdefault(family.name + ending, set())
        for sample in family.samples:
            names.setdefault(sample.name, set()).update(sample.labels)
            samples[sample.name, frozenset(sample.labels.items())] = sample.value
    return samples, names


def value(samples: Samples, name: str, **labels: str) -> float:
    return samples[name, frozenset(labels.items())]


def expressions() -> Iterator[tuple[str, str]]:
    for group in yaml.safe_load((FOLDER / "alerts.yaml").read_text())["groups"]:
        for rule in group["rules"]:
            yield rule["alert"], rule["expr"]
    for panel in json.loads((FOLDER / "dashboard.json").read_text())["panels"]:
        for target in panel["targets"]:
            yield panel["title"], target["expr"]


def used_names(expression: str) -> tuple[set[str], set[str]]:
    """Names of series and of labels in an expression; refuses what is not balanced or unknown."""
    plain = re.sub(r'"[^"]*"', '""', expression)
    for opening, closing in ("()", "{}", "[]"):
        assert plain.count(opening) == plain.count(closing), expression
    labels = {name for part in re.findall(r"\b(?:by|on) \(([^)]*)\)", plain) for name in re.split(r",\s*", part)}
    labels |= {
        name for part in re.findall(r"\{([^}]*)\}", plain) for name in re.findall(r"(\w+)\s*(?:=~|!~|!=|=)", part)
    }
    rest = re.sub(r"\{[^}]*\}|\[[^\]]*\]|\b(?:by|on) \([^)]*\)", " ", plain)
    return set(re.findall(r"\b[a-z_][a-z0-9_]*\b", rest)) - FUNCTIONS, labels


def refuse() -> None:
    raise UnreadableUpload("damaged")


def fail() -> None:
    raise Unavailable("busy")


@pytest.mark.both_databases
def test_every_name_and_label_is_in_a_scrape_and_queues_are_counted(settings: Settings) -> None:
    with measured("test") as measure:
        measure.has_read = True
    for end in (refuse, fail):
        with pytest.raises((UnreadableUpload, Unavailable)), measured("test"):
            end()
    with LiveServer(create_app(settings)) as server:
        httpx.get(f"{server.url}/healthz", trust_env=False, timeout=WITHIN_S)
        add_waiting_jobs(server)
        samples, names = scrape(server.url)
        asked = list(expressions())
        assert len(asked) > 20
        for where, expression in asked:
            series, labels = used_names(expression)
            assert series, where
            assert series - {"up"} <= set(names), where
            known = {"instance", "job", "le"}.union(*(names[name] for name in series - {"up"}))
            assert labels <= known, where
        assert value(samples, "waymark_jobs", kind="export", queue="proof", state="queued") == 3
        age_s = value(samples, "waymark_jobs_oldest_seconds", kind="export", queue="proof", state="queued")
        assert 600 <= age_s < 900
        assert value(samples, "waymark_jobs", kind="decode", queue="online", state="queued") == 0
        assert value(samples, "waymark_database_up") == 1
        assert value(samples, "waymark_decoder_processes_wanted") == 2
        assert value(samples, "waymark_database_connections_max", pool="transactions") >= 30
        # a second process reports the same queues, and a worker reports them on a port of its own
        metrics = ProcessMetrics(server.app.state.database, server_pool(server), utc_now)
        found = {m.name: m for m in metrics.collect()}
        again = [s.value for s in found["waymark_jobs"].samples if s.labels["kind"] == "export"]
        assert again == [3, 0]


def add_waiting_jobs(server: LiveServer) -> None:
    """Three exports that no queue knows, the oldest made ten minutes ago."""
    now = utc_now()
    with across_agencies(), server.app.state.database.write() as connection:
        agency_id = connection.exec_driver_sql("SELECT id FROM agencies").scalar_one()
        for k in range(3):
            job = store.new_job(JobKind.EXPORT, f"{k:036}", agency_id, "holder", now - timedelta(seconds=600 - k))
            store.add_job(connection, job)


def server_pool(server: LiveServer) -> Any:
    """The decoder processes of a server."""
    collectors = server.app.state.metrics._collector_to_names
    return next(each for each in collectors if isinstance(each, ProcessMetrics))._pool


def test_outcomes_are_told_apart() -> None:
    def count(outcome: str) -> float:
        return DECODE_METRICS.get_sample_value("waymark_decode_seconds_count", {"kind": "x", "outcome": outcome}) or 0

    with measured("x"):
        pass
    with measured("x") as measure:
        measure.has_read = True
    for end in (refuse, fail, lambda: 1 / 0):
        with pytest.raises((UnreadableUpload, Unavailable, ZeroDivisionError)), measured("x"):
            end()
    assert [count(outcome) for outcome in ("none", "read", "refused", "failed")] == [1, 1, 1, 2]


def test_a_worker_answers_on_its_own_port(settings: Settings) -> None:
    with LiveServer(create_app(settings)) as server:
        (port,) = free_ports(1)
        metrics = ProcessMetrics(server.app.state.database, server_pool(server), utc_now)
        worker = MetricsServer("127.0.0.1", port, metrics)
        try:
            samples, names = scrape(f"http://127.0.0.1:{port}")
            assert value(samples, "waymark_jobs", kind="proof", queue="proof", state="running") == 0
            assert "waymark_decode_seconds_bucket" in names
            assert httpx.get(f"http://127.0.0.1:{port}/healthz", trust_env=False, timeout=WITHIN_S).json() == {
                "status": "ok"
            }
            assert (
                httpx.get(f"http://127.0.0.1:{port}/v1/markers", trust_env=False, timeout=WITHIN_S).status_code == 404
            )
        finally:
            worker.close()


def test_rules_and_panels_are_whole() -> None:
    for group in yaml.safe_load((FOLDER / "alerts.yaml").read_text())["groups"]:
        for rule in group["rules"]:
            assert set(rule) <= {"alert", "expr", "for", "labels", "annotations"}
            assert rule["labels"]["severity"] in ("page", "ticket")
            assert rule["annotations"]["summary"]
    board = json.loads((FOLDER / "dashboard.json").read_text())
    assert board["uid"] == "waymark"
    assert len({panel["id"] for panel in board["panels"]}) == len(board["panels"]) == 12
