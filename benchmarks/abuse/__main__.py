"""``python -m benchmarks.abuse [--short] [--slack N] [--only NAME ...]``: the most expensive request of each route, and
attacks of many requests.

The exit status is 1 if a request broke a limit: 5 s of processor time, 200 MB of memory, 1 MB of error answer, 250 ms
of delay of /healthz; or if an attack broke one of its own limits or succeeded. `--slack` multiplies the limits in time,
for a machine that does other work. `--only` takes `requests`, `attacks`, or names of attacks.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import httpx

from benchmarks.abuse import protocol as protocol  # adds its attacks
from benchmarks.abuse.attacks import ATTACKS, run_attacks
from benchmarks.abuse.cases import Case, list_cases
from benchmarks.abuse.json_bodies import list_bodies, list_json_routes
from benchmarks.abuse.server import Cost, ObservedServer, running_server
from benchmarks.abuse.texts import list_text_cases

MAX_CPU_S, MAX_MEMORY_MB, MAX_ERROR_BYTES, MAX_HEALTH_MS = 5.0, 200.0, 1_000_000, 250.0
WITH_DEADLINE = {"POST /v1/artwork": 300.0}
"""Routes that cost more by design, with the time after which they stop: they run in slots and are charged. [s]
Source: `WAYMARK_REQUEST_TIMEOUT_S`."""
NOBODY = "019cb624-0000-7000-8000-00000000ffff"


class Outcome(NamedTuple):
    """A request, its cost, the status and the size of the answer."""

    case: Case
    cost: Cost
    status: int
    answer_bytes: int

    def broken(self, slack: float) -> list[str]:
        """The limits that it broke."""
        limits = (
            (self.cost.cpu_s, WITH_DEADLINE.get(self.case.route, MAX_CPU_S * slack), "processor time"),
            (self.cost.memory_mb, MAX_MEMORY_MB, "memory"),
            (self.answer_bytes if self.status >= 400 else 0, MAX_ERROR_BYTES, "error answer"),
            (self.cost.health_ms, MAX_HEALTH_MS * slack, "delay of /healthz"),
        )
        return [name for value, limit, name in limits if value > limit]

    def share(self) -> float:
        """The greatest share of a limit."""
        return max(
            self.cost.cpu_s / MAX_CPU_S, self.cost.memory_mb / MAX_MEMORY_MB, self.cost.health_ms / MAX_HEALTH_MS
        )


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.abuse", description=__doc__)
    parser.add_argument("--short", action="store_true", help="fewer and smaller cases, under a minute")
    parser.add_argument("--slack", type=float, default=1.0, help="factor of the limits in time")
    parser.add_argument("--only", action="append", choices=["requests", "attacks", *ATTACKS], help="what to run")
    arguments = parser.parse_args()
    only, short = arguments.only or ["requests", "attacks"], arguments.short
    chosen = [ATTACKS[name] for name in ATTACKS if name in only or "attacks" in only]
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory() as folder, running_server(Path(folder)) as server:
        mode = "Short" if short else "Long"
        print(f"### abuse\n\n{mode} mode.\n")
        faults = run_attacks(server, chosen, arguments.slack, short=short)
        if "requests" in only:
            ids = _make_resources(server.client)
            outcomes = [_send(server, case) for case in _all_cases(server, ids, short=short)]
    if outcomes:
        faults += _print_requests(outcomes, arguments.slack)
    print(f"\n{faults} requests or attacks broke a limit.")
    return 1 if faults else 0


def _print_requests(outcomes: list[Outcome], slack: float) -> int:
    """Print the table and the requests that broke a limit; returns how many."""
    print(f"{len(outcomes)} requests:\n")
    _print_table(outcomes)
    faults = [(outcome, broken) for outcome in outcomes if (broken := outcome.broken(slack))]
    for outcome, broken in faults:
        print(f"- {outcome.case.route}, {outcome.case.name}: {', '.join(broken)} ({_figures(outcome)})")
    return len(faults)


def _make_resources(client: httpx.Client) -> dict[str, str]:
    """One resource of each kind that paths name."""
    found: dict[str, str] = {}
    examples = {route.path: route.example for route in list_json_routes(client.get("/openapi.json").json())}
    for name, path in (
        ("road_id", "/v1/roads"),
        ("marker_id", "/v1/markers"),
        ("codebook_id", "/v1/codebooks"),
        ("vehicle_id", "/v1/vehicles"),
    ):
        response = client.post(path, json=examples[path])
        found[name] = response.json().get("id", NOBODY)
    return found


def _all_cases(server: ObservedServer, ids: dict[str, str], *, short: bool) -> Iterator[Case]:
    yield from list_cases(ids, short=short)
    yield from list_text_cases(short=short)
    document: dict[str, Any] = server.client.get("/openapi.json").json()
    for route in list_json_routes(document):
        path = re.sub(r"\{(\w+)\}", lambda name: ids.get(name[1], NOBODY), route.path)
        for name, body in list_bodies(route.example, short=short):
            headers = {"Content-Type": "application/json", "If-Match": "*"}
            yield Case(f"{route.method} {route.path}", name, route.method, path, {"content": body, "headers": headers})


def _send(server: ObservedServer, case: Case) -> Outcome:
    with server.observed() as costs:
        response = server.client.request(case.method, case.path, **case.options)
    return Outcome(case, costs[0], response.status_code, len(response.content))


def _print_table(outcomes: list[Outcome]) -> None:
    tried = Counter(outcome.case.route for outcome in outcomes)
    print("| route | tried | most expensive | processor time | memory | /healthz | answer |")
    print("|---|---|---|---|---|---|---|")
    for route in sorted(tried, key=lambda name: name.partition(" ")[2]):
        worst = max((outcome for outcome in outcomes if outcome.case.route == route), key=Outcome.share)
        print(f"| `{route}` | {tried[route]} | {worst.case.name} | {' | '.join(_cells(worst))} |")
    most = max(outcome.answer_bytes for outcome in outcomes if outcome.status >= 400)
    print(f"\nLargest error answer: {most / 1000:.1f} kB.\n")


def _cells(outcome: Outcome) -> tuple[str, ...]:
    cost = outcome.cost
    size = f"{outcome.status}, {outcome.answer_bytes / 1000:.1f} kB"
    return f"{cost.cpu_s:.2f} s", f"{cost.memory_mb:.0f} MB", f"{cost.health_ms:.0f} ms", size


def _figures(outcome: Outcome) -> str:
    return ", ".join(_cells(outcome))


if __name__ == "__main__":
    raise SystemExit(main())
