"""Ports for servers that the demo, benchmarks and tests start."""

from __future__ import annotations

import random
import socket
from contextlib import ExitStack

FIRST, LAST = 20_000, 32_000
"""Below the ports that systems hand out to clients (Linux from 32768, others from 49152 on): a connection to somewhere
else cannot take a port before its server starts, nor while the server is started again."""


def free_ports(number: int) -> list[int]:
    """Different ports of this machine that nothing listens at.

    Parameters
    ----------
    number : int

    Raises
    ------
    OSError
        No port is free.
    """
    found: list[int] = []
    with ExitStack() as probes:
        for port in random.SystemRandom().sample(range(FIRST, LAST), LAST - FIRST):
            if len(found) == number:
                return found
            probe = probes.enter_context(socket.socket())
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            found.append(port)
    raise OSError(f"fewer than {number} of the ports {FIRST} to {LAST} are free")
