"""Moves inline scripts and styles of built pages into files, so that the pages work under a strict policy.

The content security policy of /guide has no `unsafe-inline`: what stands in the page itself is not run. The theme has a
script that sets the colour scheme, a style element, and style attributes of its icons. Each distinct text becomes one
file, and each distinct style attribute one class.
"""

from __future__ import annotations

import hashlib
import re
from functools import partial
from pathlib import Path

_SCRIPT = re.compile(r"<script(?![^>]*\ssrc=)(?P<attributes>[^>]*)>(?P<text>.*?)</script>", re.DOTALL)
_STYLE = re.compile(r"<style[^>]*>(?P<text>.*?)</style>", re.DOTALL)
_STYLED_TAG = re.compile(r"<[a-zA-Z][^<>]*?\sstyle=\"[^\"]*\"[^<>]*>")
_STYLE_ATTRIBUTE = re.compile(r"\sstyle=\"([^\"]*)\"")
_CLASS_ATTRIBUTE = re.compile(r"\sclass=\"([^\"]*)\"")
_RULES = "inline.css"


def move_inline(site: Path) -> None:
    """Rewrite all pages of a folder; the files go to its folder `_static`."""
    static = site / "_static"
    rules: dict[str, str] = {}
    for page in sorted(site.rglob("*.html")):
        root = "../" * len(page.relative_to(site).parts[:-1])
        text = page.read_text()
        text = _SCRIPT.sub(partial(_script_file, static=static, root=root), text)
        text = _STYLE.sub(partial(_style_file, static=static, root=root), text)
        text = _STYLED_TAG.sub(lambda found: _with_class(found[0], rules), text)
        text = text.replace("</head>", f'<link rel="stylesheet" href="{root}_static/{_RULES}"></head>', 1)
        page.write_text(text)
    written = (f".{name} {{ {declarations.rstrip('; ')}; }}\n" for name, declarations in sorted(rules.items()))
    (static / _RULES).write_text("".join(written))


def _script_file(found: re.Match[str], static: Path, root: str) -> str:
    if "type=" in found["attributes"]:  # data, not code: the browser does not run it
        return found[0]
    return f'<script src="{root}_static/{_stored(found["text"], static, ".js")}"></script>'


def _style_file(found: re.Match[str], static: Path, root: str) -> str:
    return f'<link rel="stylesheet" href="{root}_static/{_stored(found["text"], static, ".css")}">'


def _stored(text: str, static: Path, suffix: str) -> str:
    name = f"inline-{_short_hash(text)}{suffix}"
    (static / name).write_text(text.strip() + "\n")
    return name


def _with_class(tag: str, rules: dict[str, str]) -> str:
    declarations = _STYLE_ATTRIBUTE.search(tag)
    assert declarations is not None
    name = f"inline-{_short_hash(declarations[1])}"
    rules[name] = declarations[1]
    bare = _STYLE_ATTRIBUTE.sub("", tag, count=1)
    if classes := _CLASS_ATTRIBUTE.search(bare):
        return bare.replace(classes[0], f' class="{classes[1]} {name}"', 1)
    return re.sub(r"^<[\w:-]+", lambda start: f'{start[0]} class="{name}"', bare, count=1)


def _short_hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:10]
