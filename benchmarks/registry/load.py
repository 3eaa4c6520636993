"""Requests through HTTP, as many as 16 kept-alive connections get answered; the same client for every server."""

from __future__ import annotations

import asyncio
import itertools
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import uvloop

CONNECTIONS = 16


@dataclass(frozen=True)
class Timing:
    """What a server answered in a while."""

    per_s: float  # [1/s] requests answered
    # `p50_ms`, `p99_ms`: [ms] time from the request to the last byte of its answer
    p50_ms: float
    p99_ms: float
    size_kb: float  # [kB] mean size of a body
    answered: int  # requests, with those of the warm-up


def ask(port: int, paths: Sequence[str], *, key: str = "", seconds: float, connections: int = CONNECTIONS) -> Timing:
    """Ask for the paths again and again, a second to warm up and then for some seconds.

    Raises
    ------
    RuntimeError
        An answer was neither 200 nor 204.
    """
    header = f"Host: 127.0.0.1:{port}\r\nAccept: */*\r\n" + (f"X-API-Key: {key}\r\n" if key else "")
    requests = itertools.cycle([f"GET {path} HTTP/1.1\r\n{header}\r\n".encode() for path in paths])
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        return runner.run(_ask(port, requests, seconds, connections))


async def _ask(port: int, requests: Iterator[bytes], seconds: float, connections: int) -> Timing:
    begin = time.perf_counter() + min(1.0, seconds)
    samples: list[tuple[float, float, int]] = []  # when it was asked, how long that took, how much came
    await asyncio.gather(*(_connection(port, requests, begin + seconds, samples) for _ in range(connections)))
    if not samples:
        return Timing(0.0, math.inf, math.inf, 0.0, 0)
    began, took, sizes = np.array(samples).T
    inside = (began + took >= begin) & (began + took <= begin + seconds)
    if not inside.any():
        return Timing(0.0, math.inf, math.inf, 0.0, len(samples))
    p50, p99 = np.percentile(took[inside] * 1e3, (50, 99))
    return Timing(inside.sum() / seconds, float(p50), float(p99), float(sizes[inside].mean()) / 1e3, len(samples))


async def _connection(
    port: int, requests: Iterator[bytes], end: float, samples: list[tuple[float, float, int]]
) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=2**22)
    while (began := time.perf_counter()) < end:
        writer.write(next(requests))
        size = len(await _answer(reader))
        samples.append((began, time.perf_counter() - began, size))
    writer.close()


async def _answer(reader: asyncio.StreamReader) -> bytes:
    head = (await reader.readuntil(b"\r\n\r\n")).lower()
    status = int(head[9:12])
    if status == 204:
        return b""
    if b"transfer-encoding: chunked" in head:
        body = b""
        while size := int(await reader.readuntil(b"\r\n"), 16):
            body += (await reader.readexactly(size + 2))[:-2]
        await reader.readexactly(2)
    else:
        body = await reader.readexactly(int(head.partition(b"content-length:")[2].partition(b"\r\n")[0]))
    if status != 200:
        raise RuntimeError(f"answered {status}: {body[:300]!r}")
    return body


def fetch(port: int, path: str, key: str = "") -> bytes:
    """One answer's body."""

    async def one() -> bytes:
        reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=2**22)
        keyed = f"X-API-Key: {key}\r\n" if key else ""
        writer.write(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nAccept: */*\r\n{keyed}\r\n".encode())
        body = await _answer(reader)
        writer.close()
        return body

    return asyncio.run(one())
