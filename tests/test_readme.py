"""The README's tour and the tutorials run unchanged against a real server, and must print what they show."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.readme import (
    GAP,
    PAGES,
    SHORT_MARK,
    fill_blocks,
    fill_excerpt,
    find_stamps,
    read_sections,
    stamp_sections,
)  # fmt: skip
from tests.http import WITHIN_S
from tests.machine import require_tool
from tests.tours import assert_same, read_blocks, run_blocks

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
FOR_DEVELOPERS = [path for path in DOCUMENTS if path.stem in ("README", "CONTRIBUTING", "demo", "benchmarks")]
MODULES = {name.rstrip(".") for path in FOR_DEVELOPERS for name in re.findall(r"python -m ([\w.]+)", path.read_text())}


@pytest.mark.timeout(3600)  # a loaded machine compiles the decoders for minutes
@pytest.mark.parametrize("name", ["README.md", *(f"docs/tutorials/{path.name}" for path in TUTORIALS)])
def test_commands_print_what_the_document_shows(tmp_path: Path, name: str) -> None:
    require_tool("curl")
    require_tool("bash")
    text = (ROOT / name).read_text()
    blocks = read_blocks(text)
    assert len(blocks) == len(re.findall(r"^```sh$", text, re.MULTILINE)) >= 5
    printed = run_blocks(blocks, tmp_path)
    for (commands, expected), got in zip(blocks, printed, strict=True):
        assert_same(got.strip(), expected.strip(), commands)


def test_there_is_a_tutorial_for_each_kind_of_user() -> None:
    assert {path.stem for path in TUTORIALS} >= {"planner", "fabricator", "vehicle-engineer", "operator"}


@pytest.mark.parametrize("name", sorted(MODULES))
def test_documented_modules_can_be_run(name: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", name, "--help"], cwd=ROOT, capture_output=True, text=True, timeout=WITHIN_S
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "usage" in done.stdout


def test_pictures_are_small() -> None:
    texts = "".join(path.read_text() for path in DOCUMENTS)
    pictures = [*(ROOT / "docs" / "images").glob("*.jpg"), *(ROOT / "docs" / "images").glob("*.png")]
    assert len(pictures) >= 4
    for picture in pictures:
        assert picture.stat().st_size < 300_000, picture.name
        assert f"images/{picture.name}" in texts, f"{picture.name} is not shown"


def test_benchmark_blocks_are_filled_by_name_and_nothing_else_changes() -> None:
    readme = "a\n<!-- bench:one -->\nold\n<!-- /bench -->\nb\n<!-- bench:two -->\nkept\n<!-- /bench -->\n"
    output = "Seeds 1\n\n### one\n\nnote\n\n| x |\n|---|\n| 1 |\n\nWrong digits:\n- frame\n\n### three\n\n| y |\n"
    filled = fill_blocks(readme, read_sections(output))
    assert filled == readme.replace("\nold\n", "\n\nnote\n\n| x |\n|---|\n| 1 |\n\n")
    assert fill_blocks(filled, read_sections(output)) == filled


def test_the_readme_gets_the_figures_of_a_new_demo() -> None:
    def readme(*lines: str) -> str:
        return (
            "a\n<!-- lines of docs/demo.md -->\n\n```text\n" + "".join(f"{line}\n" for line in lines) + "```\n\nb ```\n"
        )

    demo = "start\n\nread  7 of 9\n----  ------\ncost: 21,318.50 EUR\nread  8 of 9\nend\n"
    old = readme("read  1 of 2", GAP, "read  2 of 2")
    assert fill_excerpt(old, demo) == readme(GAP, "read  7 of 9", GAP, "read  8 of 9", GAP)
    cost = readme("read  1 of 2", "cost: 5 EUR", "end")
    assert fill_excerpt(cost, demo) == readme(GAP, "read  7 of 9", "cost: 21,318.50 EUR", GAP, "end")
    for gone in (readme("written  1 of 2"), readme("cost: 5 EUR", "start"), readme(*3 * ["read  1 of 2"]), "a\n"):
        with pytest.raises(ValueError, match="the README"):
            fill_excerpt(gone, demo)


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
    blocks += ["bundle", "http", "video", "track", "health", "abuse", "abuse-reads-sqlite", "abuse-reads-postgresql"]
    filled = [name for page in PAGES for name in re.findall(r"<!-- bench:([\w-]+) -->", page.read_text())]
    assert sorted(filled) == sorted(blocks)


def test_pictures_of_tutorials_are_small_and_shown() -> None:
    texts = "".join(path.read_text() for path in TUTORIALS)
    pictures = [path for path in (ROOT / "docs/images/tutorials").iterdir() if path.suffix in (".png", ".jpg")]
    assert len(pictures) >= 8
    for picture in pictures:
        assert picture.stat().st_size <= 150_000, picture.name
        assert f"images/tutorials/{picture.name}" in texts, f"{picture.name} is not shown"


def test_tables_state_the_decoder_that_made_them_and_none_mixes_versions() -> None:
    text = stamp_sections("### trials\n\n| a |\n", "plate/8") + stamp_sections("### recall\n\n| b |\n", "matched-9")
    page = fill_blocks(
        "<!-- bench:trials -->\n<!-- /bench -->\n<!-- bench:recall -->\n<!-- /bench -->", read_sections(text)
    )
    assert find_stamps(page) == {"plate": {8}, "matched": {9}}
    assert find_stamps(page + "\n*Decoder: `plate/7`.*\n")["plate"] == {7, 8}
    stated = find_stamps((ROOT / "docs" / "benchmarks.md").read_text())
    assert all(len(versions) == 1 for versions in stated.values()), stated
