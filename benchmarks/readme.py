"""``python -m benchmarks.readme FILE``: put what the benchmarks printed into the README and docs/benchmarks.md.

A section ``### NAME`` of the file replaces what stands between ``<!-- bench:NAME -->`` and ``<!-- /bench -->``; blocks
without a section stay as they are. Where the file comes from a short mode, each of its blocks says so.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / "README.md", ROOT / "docs" / "benchmarks.md")
SHORT_MARK = "*Short mode: a sample of the scenes.*"
_BLOCK = re.compile(r"(<!-- bench:(?P<name>[\w-]+) -->\n)(?P<body>.*?)(<!-- /bench -->)", re.DOTALL)


def read_sections(text: str) -> dict[str, str]:
    """Sections of a benchmark's output by name, marked where a run in short mode printed them."""
    parts = re.split(r"^### ([\w-]+)\n", text, flags=re.MULTILINE)
    mark = f"{SHORT_MARK}\n\n" if re.search(r"\bshort mode\b", text, flags=re.IGNORECASE) else ""
    return {name: mark + _without_lists(body) for name, body in zip(parts[1::2], parts[2::2], strict=True)}


def fill_blocks(page: str, sections: dict[str, str]) -> str:
    """A page with its blocks filled."""

    def fill(block: re.Match[str]) -> str:
        body = sections.get(block["name"])
        return block[0] if body is None else f"{block[1]}\n{body}\n\n{block[4]}"

    return _BLOCK.sub(fill, page)


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


if __name__ == "__main__":
    main()
