"""From documents to a site: sources into one folder, Sphinx, then no inline scripts and styles."""

from __future__ import annotations

import io
import os
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

from app import __version__, shipped_folder
from guide.inline import move_inline
from guide.sources import ROOT, gather_sources

__all__ = ["ROOT", "GuideError", "build_guide"]

_HERE = Path(__file__).resolve().parent
_COLOUR = re.compile(r"\x1b\[[\d;]*m")
_CONFIGURATION: dict[str, Any] = {
    "project": "Waymark",
    "release": __version__,
    "html_title": "Waymark",
    "root_doc": "index",
    "extensions": ["myst_parser"],
    "exclude_patterns": [],
    # Documents are CommonMark with tables, as the repository shows them; only the generated navigation is a directive.
    "myst_disable_syntax": ["myst_role", "myst_target", "myst_line_comment", "myst_block_break"],
    "myst_heading_anchors": 4,
    "html_theme": "furo",
    "html_theme_options": {"top_of_page_buttons": []},
    "html_static_path": [str(_HERE / "static")],
    "html_css_files": ["guide.css"],
    "html_favicon": str(shipped_folder("static") / "favicon.svg"),
    "html_copy_source": False,
    "html_show_copyright": False,
    "html_use_index": False,
    "html_permalinks_icon": "#",
    "pygments_style": "default",
    "highlight_language": "none",
    "suppress_warnings": ["misc.highlighting_failure"],
}


class GuideError(Exception):
    """A document has a fault; the text has one line for each."""


def build_guide(out: Path) -> None:
    """Write the site to a folder, which is replaced only when all of it is built.

    Raises
    ------
    GuideError
        Sphinx warned of something: a link without a target, a page that is in no list, a heading of the wrong level.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".guide-", dir=out.parent) as folder:
        work = Path(folder)
        gather_sources(work / "sources")
        _run_sphinx(work)
        site = work / "site"
        for name in (".buildinfo", "objects.inv"):
            (site / name).unlink(missing_ok=True)
        for path in site.rglob("*.map"):  # of scripts and styles, for their authors
            path.unlink()
        move_inline(site)
        if out.exists():
            os.rename(out, work / "old")
        shutil.copytree(site, work / "new")  # with the usual permissions
        os.rename(work / "new", out)


def _run_sphinx(work: Path) -> None:
    warnings = io.StringIO()
    sources = work / "sources"
    sphinx = Sphinx(
        srcdir=sources, confdir=None, outdir=work / "site", doctreedir=work / "doctrees", buildername="html",
        confoverrides=_CONFIGURATION, status=None, warning=warnings,
    )  # fmt: skip
    sphinx.build()
    if found := _COLOUR.sub("", warnings.getvalue()).strip():
        raise GuideError(found.replace(f"{sources}/", ""))
