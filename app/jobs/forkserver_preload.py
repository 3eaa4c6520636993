"""Imported first in the process that decoder processes are forks of: it ends with the server.

Python's forkserver notices the end of the server when it waits for requests, but not while it imports the decoders,
which takes seconds.
"""

from __future__ import annotations

import os
import signal
import sys

_CHECK_S = 0.5


def end_with_parent() -> None:
    """Have a timer end this process when its parent has ended; a fork of it has no timer."""
    parent = os.getppid()

    def check(*_: object) -> None:
        if os.getppid() != parent:
            os._exit(0)

    signal.signal(signal.SIGALRM, check)
    signal.setitimer(signal.ITIMER_REAL, _CHECK_S, _CHECK_S)


if any("multiprocessing.forkserver" in argument for argument in sys.orig_argv):
    end_with_parent()
