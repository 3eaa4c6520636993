"""HTML by functions: every text is escaped, unless it is the result of one of them."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import TypeAlias

_VOID = ("link", "meta")


class Markup(str):
    """A text that is HTML already."""

    __slots__ = ()


Content: TypeAlias = "str | Iterable[str] | None"


def element(name: str, /, *content: Content, **attributes: str | None) -> Markup:
    """An element.

    Parameters
    ----------
    name : str
    content : str, or iterable of str
        Texts, which are escaped, and elements. None is left out.
    attributes : str
        Their values, escaped. ``class_`` stands for ``class``, ``aria_label`` for ``aria-label``; None is left out.
    """
    given = "".join(
        f' {attribute.rstrip("_").replace("_", "-")}="{escape(value)}"'
        for attribute, value in attributes.items()
        if value is not None
    )
    if name in _VOID:
        return Markup(f"<{name}{given}>")
    return Markup(f"<{name}{given}>{joined(content)}</{name}>")


def joined(content: Iterable[Content]) -> Markup:
    """Texts and elements one after the other."""
    pieces: list[str] = []
    for part in content:
        if part is None:
            continue
        for text in (part,) if isinstance(part, str) else part:
            pieces.append(text if isinstance(text, Markup) else escape(text))
    return Markup("".join(pieces))


def anchor(href: str, text: str, **attributes: str | None) -> Markup:
    """A link."""
    return element("a", text, href=href, **attributes)


def table(caption: str, columns: Iterable[Content], rows: Iterable[Iterable[Content]], **attributes: str) -> Markup:
    """A table whose first column names its rows, in a region that scrolls by keyboard as well where it is too wide."""
    head = element("tr", (element("th", column, scope="col") for column in columns))
    body = (
        element("tr", (element("td" if k else "th", cell, scope=None if k else "row") for k, cell in enumerate(row)))
        for row in rows
    )
    made = element("table", element("caption", caption), element("thead", head), element("tbody", body), **attributes)
    return element("div", made, class_="wide", role="region", aria_label=caption, tabindex="0")
