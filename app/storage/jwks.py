"""The public keys of an OIDC issuer (RFC 7517), from a URL or a file."""

from __future__ import annotations

from pathlib import Path

import httpx

from app.errors import Unavailable

MAX_BYTES = 256 * 1024
"""Largest key set. [byte]"""
_TIMEOUT_S = 5.0  # [s]


def read_jwks(source: str) -> bytes:
    """The key set at a URL or in a file, not parsed.

    Raises
    ------
    Unavailable
        It cannot be read, or is too large.
    """
    try:
        content = _fetched(source) if source.startswith(("https://", "http://")) else Path(source).read_bytes()
    except (OSError, httpx.HTTPError) as error:
        raise Unavailable("the issuer's keys cannot be read", cure="try again in a few seconds") from error
    if len(content) > MAX_BYTES:
        raise Unavailable("the issuer's key set is too large", limit=f"{MAX_BYTES} bytes")
    return content


def _fetched(url: str) -> bytes:
    content = b""
    with httpx.stream("GET", url, timeout=_TIMEOUT_S, follow_redirects=False) as response:
        response.raise_for_status()
        for part in response.iter_bytes():
            content += part
            if len(content) > MAX_BYTES:
                break
    return content
