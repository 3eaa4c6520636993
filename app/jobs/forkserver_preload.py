"""Imported first in the process that decoder processes are forks of, and nowhere else: it ends with the server.

Python's forkserver notices the end of the server when it waits for requests, but not while it imports the decoders,
which takes seconds.
"""

from __future__ import annotations

import os
import signal

_CHECK_S = 0.5
_SERVER = os.getppid()


def _end_with_the_server(*_: object) -> None:
    if os.getppid() != _SERVER:
        os._exit(0)


signal.signal(signal.SIGALRM, _end_with_the_server)
signal.setitimer(signal.ITIMER_REAL, _CHECK_S, _CHECK_S)  # a fork has no timer
