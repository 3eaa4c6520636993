"""Commands that a document shows, run as they are against real servers, and what they print.

A block of `sh` is run; the block of `text` that follows it is what it prints, or nothing if there is none. All blocks
of a document are one script. ``python -m tests.tours FILE...`` puts into documents what their commands print now.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from app.demo.server import free_ports

ROOT = Path(__file__).resolve().parents[1]
_BLOCK = re.compile(
    r"^```sh\n(?P<commands>.*?)^```\n(?:\n+^```text\n(?P<printed>.*?)^```\n)?", re.MULTILINE | re.DOTALL
)
_NUMBER = re.compile(r"(?<![\w.])-?\d+\.\d+")
_END = "=== end of block ==="


def read_blocks(text: str) -> list[tuple[str, str]]:
    """Commands and what they print, block by block."""
    return [(found["commands"], found["printed"] or "") for found in _BLOCK.finditer(text)]


def run_blocks(blocks: list[tuple[str, str]], folder: Path) -> list[str]:
    """What each block prints, run in a folder in which docs/ and app/ are as in a checkout.

    `WAYMARK_PORT=8000` becomes a free port; what is started in the background is stopped at the end.
    """
    for name in ("docs", "app"):
        (folder / name).symlink_to(ROOT / name)
    programs = folder / "bin"
    programs.mkdir()
    for name, arguments in (("waymark", '-c "from app.cli import main; main()"'), ("python", "")):
        (programs / name).write_text(f'#!/bin/sh\nexec {sys.executable} {arguments} "$@"\n')
        (programs / name).chmod(0o755)
    script = f"\necho '{_END}'\n".join(commands for commands, _ in blocks)
    script = script.replace("WAYMARK_PORT=8000", f"WAYMARK_PORT={free_ports(1)[0]}")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("WAYMARK_")} | {
        "PATH": f"{programs}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "COLUMNS": "100",
        "no_proxy": "127.0.0.1",
    }
    stop = "trap 'kill $(jobs -p) 2> /dev/null || true; wait' EXIT\n"
    done = subprocess.run(
        ["bash", "-c", f"set -euo pipefail\n{stop}{script}"],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.split(f"{_END}\n")


def assert_same(got: str, expected: str, commands: str) -> None:
    """Texts are equal but for the last digits of measured numbers, and blanks at the ends of lines."""
    got = "\n".join(line.rstrip() for line in got.splitlines())
    assert _NUMBER.sub("#", got) == _NUMBER.sub("#", expected), commands
    for mine, shown in zip(_NUMBER.findall(got), _NUMBER.findall(expected), strict=True):
        assert float(mine) == pytest.approx(float(shown), abs=0.02), f"{mine} in place of {shown}: {commands}"


def with_printed(text: str, printed: list[str]) -> str:
    """A document whose blocks show what their commands printed."""
    left = iter(printed)

    def shown(found: re.Match[str]) -> str:
        lines = "".join(f"{line.rstrip()}\n" for line in next(left).strip("\n").splitlines())
        return f"```sh\n{found['commands']}```\n" + (f"\n```text\n{lines}```\n" if lines else "")

    return _BLOCK.sub(shown, text)


def main() -> None:
    """Run documents, and write what they print into them."""
    parser = argparse.ArgumentParser(prog="python -m tests.tours", description=__doc__)
    parser.add_argument("file", type=Path, nargs="+")
    for path in parser.parse_args().file:
        text = path.read_text()
        with tempfile.TemporaryDirectory() as folder:
            path.write_text(with_printed(text, run_blocks(read_blocks(text), Path(folder))))
        print(path)


if __name__ == "__main__":
    main()
