"""What browsers may do on our pages: the Content-Security-Policy, which allows nothing that is not named here."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable
from urllib.parse import urlsplit

_IMPORT_MAP = re.compile(r'<script type="importmap">(.*?)</script>', re.DOTALL)


def content_security_policy(
    *, hosts: Iterable[str] = (), scripts: Iterable[str] = (), styles: Iterable[str] = (), pictures: str = "blob:"
) -> str:
    """The policy of a page: scripts, styles and requests of this host only, none of them inline.

    Parameters
    ----------
    hosts : iterable of str
        Origins to which the page may send requests, besides its own: those that the operator configured.
    scripts, styles : iterable of str
        Hashes of inline scripts and styles that are allowed.
    pictures : str
        Scheme of pictures that come from no host.
    """
    more = "".join(f" {host}" for host in hosts)
    return "; ".join((
        "default-src 'none'",
        " ".join(("script-src 'self'", *scripts)),
        " ".join(("style-src 'self'", *styles)),
        f"img-src 'self' {pictures}{more}",
        f"connect-src 'self'{more}",
        "worker-src 'self'",
        "form-action 'self'",
        "base-uri 'none'",
        "frame-ancestors 'none'",
    ))  # fmt: skip


def import_map_hashes(page: str) -> list[str]:
    """Hashes of a page's import maps: browsers take one from inside the page only, and run no script in it."""
    return [hash_of(text) for text in _IMPORT_MAP.findall(page)]


def hash_of(text: str) -> str:
    """The hash of an inline script or style as a policy names it."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def origin_of(url: str) -> str | None:
    """Scheme and host of an address; None if it is on this host."""
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc}" if parts.scheme in ("http", "https") and parts.netloc else None
