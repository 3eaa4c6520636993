"""The README's tour runs unchanged against a real server, and must print what the README shows."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from app.demo.free_ports import free_ports
from benchmarks.readme import PAGES, SHORT_MARK, fill_blocks, read_sections
from tests.http import WITHIN_S

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
TOUR = README.split("## Five minutes")[1].split("\n## ")[0]
BLOCKS = re.findall(r"^```sh\n(.*?)^```\n+(?:^```text\n(.*?)^```)", TOUR, re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"(?<![\w.])-?\d+\.\d+")
END = "=== end of block ==="


def require(name: str) -> None:
    """Skip without a program; on CI fail."""
    if shutil.which(name) is None:
        if os.environ.get("CI"):
            pytest.fail(f"{name} is not installed")
        pytest.skip(f"{name} is not installed")


@pytest.mark.slow
@pytest.mark.timeout(3600)  # a loaded machine compiles the decoders for minutes
def test_the_tour_prints_what_the_readme_shows(tmp_path: Path) -> None:
    require("curl")
    require("bash")
    assert len(BLOCKS) == len(re.findall(r"^```sh$", README, re.MULTILINE)) >= 6
    for folder in ("docs", "app"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "waymark").write_text(f'#!/bin/sh\nexec {sys.executable} -c "from app.cli import main; main()" "$@"\n')
    (programs / "waymark").chmod(0o755)
    script = f"\necho '{END}'\n".join(commands for commands, _ in BLOCKS)
    script = script.replace("WAYMARK_PORT=8000", f"WAYMARK_PORT={free_ports(1)[0]}")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("WAYMARK_")} | {
        "PATH": f"{programs}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "no_proxy": "127.0.0.1",
    }
    stop = "trap 'kill $(jobs -p) 2> /dev/null || true; wait' EXIT\n"
    done = subprocess.run(
        ["bash", "-c", f"set -euo pipefail\n{stop}{script}"],
        cwd=tmp_path, env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    printed = done.stdout.split(f"{END}\n")
    for (commands, expected), got in zip(BLOCKS, printed, strict=True):
        assert_same(got.strip(), expected.strip(), commands)


def assert_same(got: str, expected: str, commands: str) -> None:
    """Texts are equal but for the last digits of measured numbers."""
    assert NUMBER.sub("#", got) == NUMBER.sub("#", expected), commands
    for mine, shown in zip(NUMBER.findall(got), NUMBER.findall(expected), strict=True):
        assert float(mine) == pytest.approx(float(shown), abs=0.02), f"{mine} in place of {shown}: {commands}"


@pytest.mark.parametrize("name", re.findall(r"python -m ([\w.]+)", README))
def test_documented_modules_can_be_run(name: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", name, "--help"], cwd=ROOT, capture_output=True, text=True, timeout=WITHIN_S
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "usage" in done.stdout


def test_pictures_are_small() -> None:
    pictures = [*(ROOT / "docs" / "images").glob("*.jpg"), *(ROOT / "docs" / "images").glob("*.png")]
    assert len(pictures) >= 4
    for picture in pictures:
        assert picture.stat().st_size < 300_000, picture.name
        assert picture.name in README, f"{picture.name} is not shown"


def test_benchmark_blocks_are_filled_by_name_and_nothing_else_changes() -> None:
    readme = "a\n<!-- bench:one -->\nold\n<!-- /bench -->\nb\n<!-- bench:two -->\nkept\n<!-- /bench -->\n"
    output = "Seeds 1\n\n### one\n\nnote\n\n| x |\n|---|\n| 1 |\n\nWrong digits:\n- frame\n\n### three\n\n| y |\n"
    filled = fill_blocks(readme, read_sections(output))
    assert filled == readme.replace("\nold\n", "\n\nnote\n\n| x |\n|---|\n| 1 |\n\n")
    assert fill_blocks(filled, read_sections(output)) == filled


def test_blocks_from_a_short_mode_are_marked() -> None:
    page = "<!-- bench:one -->\nold\n<!-- /bench -->\n"
    output = "### one\n\nnote\n\n### one-run\n\nSeed 1, short mode; 2 s.\n"
    assert SHORT_MARK in fill_blocks(page, read_sections(output))
    assert SHORT_MARK not in fill_blocks(page, read_sections(output.replace("short", "long")))


def test_every_benchmark_has_its_block() -> None:
    from benchmarks.cerpm.__main__ import ITEMS as CERPM
    from benchmarks.hunt.families import FAMILIES as HUNTED
    from benchmarks.magnets.__main__ import ITEMS as MAGNETS
    from benchmarks.planning.__main__ import RUNS as PLANNING
    from benchmarks.plates.__main__ import ITEMS as PLATES
    from benchmarks.service.__main__ import PARTS as SERVICE

    magnets = [f"magnets-{item}" for item in ("run", *MAGNETS)]
    cerpm = [f"cerpm-{item}" for item in ("run", *CERPM)]
    imports = [f"imports-{item}" for item in ("faults", "clean", "speed")]
    registry = [f"registry-{item}" for item in ("boxes", "tiles", "searches", "growth")]
    service = [f"service-{part}" for part in SERVICE]
    planning = [f"planning-{item}" for item in ("run", *PLANNING)]
    hunts = [f"hunt-{family}" for family in HUNTED]
    blocks = ["demo", "run", *hunts, *PLATES, *magnets, *cerpm, *imports, *registry, *planning, *service]
    blocks += ["bundle", "http", "video", "track", "health"]
    filled = [name for page in PAGES for name in re.findall(r"<!-- bench:([\w-]+) -->", page.read_text())]
    assert sorted(filled) == sorted(blocks)
