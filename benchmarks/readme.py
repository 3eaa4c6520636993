"""``python -m benchmarks.readme FILE``: put what the benchmarks printed into docs/ and the README.

A section ``### NAME`` of the file replaces what stands between ``<!-- bench:NAME -->`` and ``<!-- /bench -->``; blocks
without a section stay as they are. Where the file comes from a short mode, each of its blocks says so. The README shows
some lines of docs/demo.md, which then have the figures of the new run.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
DEMO = ROOT / "docs" / "demo.md"
PAGES = (DEMO, ROOT / "docs" / "benchmarks.md")
SHORT_MARK = "*Short mode: a sample of the scenes.*"
_STAMP = re.compile(r"^\*Decoder: `(?P<family>[a-z]+)[/-](?P<number>\d+)`\.\*$", re.MULTILINE)
GAP = "..."
"""Stands in the README's lines of the demo where others are left out."""
_BLOCK = re.compile(r"(<!-- bench:(?P<name>[\w-]+) -->\n)(?P<body>.*?)(<!-- /bench -->)", re.DOTALL)
_DEMO = re.compile(r"<!-- bench:demo -->\s+```text\n(?P<lines>.*?)```", re.DOTALL)
_EXCERPT = re.compile(r"(?<=<!-- lines of docs/demo.md -->\n\n```text\n)(?P<lines>.*?)(?=```)", re.DOTALL)
_NUMBER = re.compile(r"\d+(?:,\d{3})*(?:\.\d+)?")


def read_sections(text: str) -> dict[str, str]:
    """Sections of a benchmark's output by name, marked where a run in short mode printed them."""
    parts = re.split(r"^### ([\w-]+)\n", text, flags=re.MULTILINE)
    mark = f"{SHORT_MARK}\n\n" if re.search(r"\bshort mode\b", text, flags=re.IGNORECASE) else ""
    return {name: mark + _without_lists(body) for name, body in zip(parts[1::2], parts[2::2], strict=True)}


def stamp_sections(text: str, version: str) -> str:
    """A benchmark's output with the decoder's version below each heading of a section."""
    return re.sub(r"^(### [\w-]+\n)", rf"\1\n*Decoder: `{version}`.*\n", text, flags=re.MULTILINE)


def find_stamps(page: str) -> dict[str, set[int]]:
    """Versions that the tables of a page state, by family of decoders: more than one are mixed."""
    found: dict[str, set[int]] = {}
    for stamp in _STAMP.finditer(page):
        found.setdefault(stamp["family"], set()).add(int(stamp["number"]))
    return found


def fill_blocks(page: str, sections: dict[str, str]) -> str:
    """A page with its blocks filled."""

    def fill(block: re.Match[str]) -> str:
        body = sections.get(block["name"])
        return block[0] if body is None else f"{block[1]}\n{body}\n\n{block[4]}"

    return _BLOCK.sub(fill, page)


def find_demo(page: str) -> str:
    """What the demo printed, as docs/demo.md shows it."""
    found = _DEMO.search(page)
    assert found is not None, "no block of the demo"
    return found["lines"]


def fill_excerpt(readme: str, demo: str) -> str:
    """The README with the figures of `demo` in its lines of the demo.

    Each is the first line with the same text, numbers apart, after the one before.

    Raises
    ------
    ValueError
        The demo no longer prints one of the lines, or prints them in another order.
    """
    lines = [line for line in demo.splitlines() if re.search(r"\w", line)]

    def fill(excerpt: re.Match[str]) -> str:
        shown, after = [], 0
        for wanted in excerpt["lines"].splitlines():
            if wanted == GAP:
                continue
            at = next((i for i in range(after, len(lines)) if _shape(lines[i]) == _shape(wanted)), None)
            if at is None:
                raise ValueError(f"the demo does not print this line of the README, or not in this order: {wanted}")
            shown += [GAP] * (at > after) + [lines[at]]
            after = at + 1
        return "".join(f"{line}\n" for line in shown + [GAP] * (after < len(lines)))

    filled, count = _EXCERPT.subn(fill, readme)
    if count != 1:
        raise ValueError("the README does not have its lines of the demo once")
    return filled


def _shape(line: str) -> str:
    """A line without its numbers."""
    return " ".join(_NUMBER.sub("#", line).split())


def _without_lists(body: str) -> str:
    """The section up to the lists of single frames that may follow the last table."""
    return re.split(r"^(?:Wrong digits:|Not decoded at )", body, flags=re.MULTILINE)[0].strip()


def main() -> None:
    """Fill the pages."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.readme", description=__doc__)
    parser.add_argument("file", type=Path, nargs="+", help="output of the benchmarks")
    sections: dict[str, str] = {}
    for path in parser.parse_args().file:
        sections |= read_sections(path.read_text())
    for page in PAGES:
        text = page.read_text()
        page.write_text(fill_blocks(text, sections))
        filled = [block["name"] for block in _BLOCK.finditer(text) if block["name"] in sections]
        print(f"{page.name}: {', '.join(filled) or 'nothing'}")
    README.write_text(fill_excerpt(README.read_text(), find_demo(DEMO.read_text())))
    print("README.md: lines of the demo; compare its table with docs/benchmarks.md (tests/test_docs.py does)")


if __name__ == "__main__":
    main()
