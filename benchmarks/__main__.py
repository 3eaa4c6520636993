"""``python -m benchmarks [--short] [--only NAME]``: benchmarks, one after the other; output is kept in bench-out/.

The exit status is not 0 if a benchmark could not be run; goals that were missed are in the tables.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from app.decoders.magnet.decoder import VERSION as MAGNETS
from app.decoders.plate import DECODER_VERSION as PLATES
from benchmarks.readme import stamp_sections

OUT = Path("bench-out")
VERSIONS = {"plates": PLATES, "magnets": MAGNETS}
"""Decoders whose version each of a benchmark's tables states."""


def main() -> int:
    """Run them, print what they print, and write it to a file for ``python -m benchmarks.readme``."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--short", action="store_true", help="a sample of everything, a few minutes")
    parser.add_argument("--only", choices=[name for name, *_ in _list_commands(short=False)], help="one of them")
    chosen = parser.parse_args()
    OUT.mkdir(exist_ok=True)
    path = OUT / f"{chosen.only or ('short' if chosen.short else 'bench')}.md"
    commands = [one for one in _list_commands(chosen.short) if chosen.only in (None, one[0])]
    with path.open("w") as file:
        failed = [name for name, *command in commands if not _run(name, command, file.write)]
    print(f"\nWritten to {path}; `python -m benchmarks.readme {path}` puts the tables into the documents.")
    if failed:
        print(f"Could not be run: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def _list_commands(short: bool) -> list[list[str]]:
    return [
        ["demo", "-c", "from app.cli import main; main()", "demo", "--out", str(OUT / "demo")],
        ["bundle", "-m", "benchmarks.bundle", *(["--plates", "100"] if short else [])],
        ["http", "-m", "benchmarks.http_overhead", *(["--frames", "20"] if short else [])],
        ["plates", "-m", "benchmarks.plates", *(["--short"] if short else [])],
        ["magnets", "-m", "benchmarks.magnets", *(["--short"] if short else [])],
        ["cerpm", "-m", "benchmarks.cerpm", *(["--short"] if short else [])],
        ["imports", "-m", "benchmarks.imports", *(["--short"] if short else [])],
        ["planning", "-m", "benchmarks.planning", *(["--short"] if short else [])],
        ["track", "-m", "benchmarks.track", *(["--short"] if short else [])],
        ["registry", "-m", "benchmarks.registry", *(["--short"] if short else [])],
    ]


def _run(name: str, command: list[str], write: Callable[[str], object]) -> bool:
    """Run a program; a text without a heading of its own is set as it is."""
    process = subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        print(line, end="", flush=True)
        lines.append(line)
    text = "".join(lines)
    if name in VERSIONS:
        text = stamp_sections(text, VERSIONS[name])
    if text.lstrip().startswith("### "):
        write(f"{text.lstrip()}\n")
    elif "\n### " in text:
        write(f"### run\n\n{text}\n")  # what comes before its first table: seeds, frames, mode
    else:
        write(f"### {name}\n\n```text\n{text}```\n\n")
    return process.wait() in (0, 1) and bool(lines)  # 1: a goal was missed, which the table says


if __name__ == "__main__":
    raise SystemExit(main())
