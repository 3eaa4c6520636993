"""Imported in the process that decoder processes are forks of: it ends with the server, and loads what they use.

Python's forkserver notices the end of the server when it waits for requests, but not while it imports the decoders,
which takes seconds.

The decoders and their compiled kernels are loaded once, here, and the decoder processes share that memory until they
write to it. A fork has only the thread that made it, so nothing here may start a second one (tests/jobs/test_pool.py).
The supervisors ask for a forkserver by name, so that this holds on Python 3.11 to 3.13, whatever the default is there.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from importlib import import_module

_CHECK_S = 0.5
TASKS = (
    "app.services.decodes.frame_tasks",
    "app.services.decodes.packet_tasks",
    "app.services.decodes.trace_tasks",
    "app.services.decodes.video_tasks",
    "app.services.drives.tasks",
    "app.services.fleet.tasks",
    "app.services.markers.tasks",
    "app.services.plans.tasks",
    "app.services.public_pages.tasks",
    "app.services.surveys.tasks",
)
DECODERS = (
    "app.decoders.magnet.decoder",
    "app.decoders.magnet.recording_check",
    "app.decoders.plate.accumulate",
    "app.decoders.plate.follow_plate",
    "app.decoders.plate.print_grade",
    "app.decoders.plate.reader",
    "app.decoders.plate.video_search",
    "app.lanes.control",
    "app.lanes.estimate",
    "app.planning.build_alignment",
    "app.planning.planner",
    "app.planning.predict.printed_plate",
    "app.planning.proof.drives",
    "app.planning.proof.prove",
    "app.plots.print_report",
    "app.simulation.magnetic.dipoles",
    "app.simulation.steering",
)
"""What tasks import when they run, without what is too large or too rare for a process to have it from its start."""


def end_with_parent() -> None:
    """Have a timer end this process when its parent has ended; a fork of it has no timer."""
    parent = os.getppid()

    def check(*_: object) -> None:
        if os.getppid() != parent:
            os._exit(0)

    signal.signal(signal.SIGALRM, check)
    signal.setitimer(signal.ITIMER_REAL, _CHECK_S, _CHECK_S)


def load_decoders() -> None:
    """Import all, and run the plate decoder once; garbage collection in a fork then leaves all of it alone."""
    gc.disable()  # it would free nothing and take a fifth of the time
    from app.decoding.frames import decode_plates
    from app.jobs.decoder_process import warm_process

    for name in (*TASKS, *DECODERS):
        import_module(name)
    gc.enable()
    warm_process(decode_plates)


if any("multiprocessing.forkserver" in argument for argument in sys.orig_argv):
    end_with_parent()
    load_decoders()
