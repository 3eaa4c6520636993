"""``python -m benchmarks.service [--short] [--only PART]``: the service as a whole, part by part.

Each part prints tables as Markdown. Parts that need PostgreSQL or RabbitMQ take them from WAYMARK_BENCH_POSTGRES_URL
(an empty database with PostGIS) and WAYMARK_BENCH_BROKER_URL, and leave those rows out without them; `kills` starts its
own.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable

from benchmarks.service import kills, limits, malformed, overload, soak, start, throughput


def _engines() -> tuple[str, ...]:
    has_fleet = "WAYMARK_BENCH_POSTGRES_URL" in os.environ and "WAYMARK_BENCH_BROKER_URL" in os.environ
    return ("embedded", "celery") if has_fleet else ("embedded",)


def _throughput(short: bool) -> str:
    return throughput.tables(short, _engines())


def _malformed(short: bool) -> str:
    return malformed.tables(short, _engines())


def _soak(short: bool) -> str:
    return soak.tables(1.0 if short else 60.0)


PARTS: dict[str, tuple[str, Callable[[bool], str]]] = {
    "start": ("Start of a server, and its memory when it is idle", start.tables),
    "throughput": ("Throughput, compared with two bare decoder processes", _throughput),
    "limits": ("Limits of the database, and what a fleet needs", limits.tables),
    "overload": (
        "Response times of a probe (GET) while 64 clients, or slow connections, load the server",
        overload.tables,
    ),
    "malformed": ("Damaged and hostile files through the upload routes", _malformed),
    "kills": ("kill -9 of every process of a service", kills.tables),
    "soak": ("An hour of load", _soak),
}
"""Heading, and what makes the tables of a part; its argument is whether to run the short mode."""


def main() -> None:
    """Run the parts and print their tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.service", description=__doc__)
    parser.add_argument("--short", action="store_true", help="a sample of everything")
    parser.add_argument("--only", choices=PARTS, help="one part")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # so that what was started is ended
    for name, (heading, tables) in PARTS.items():
        if arguments.only in (None, name):
            print(f"### service-{name}\n\n{heading}.\n\n{tables(arguments.short)}\n", flush=True)


if __name__ == "__main__":
    main()
