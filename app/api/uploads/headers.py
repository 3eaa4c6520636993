"""Request and response headers of tus 1.0 (https://tus.io/protocols/resumable-upload)."""

from __future__ import annotations

import base64
import binascii
import hashlib
from collections.abc import Mapping
from email.utils import format_datetime
from typing import Any, NamedTuple

from fastapi import Request

from app.errors import MalformedRequest, UnsupportedVersion
from app.services.uploads.documents import UploadDocument

VERSION = "1.0.0"
BODY = "application/offset+octet-stream"
EXTENSIONS = "creation,creation-with-upload,termination,checksum,expiration"
ALGORITHMS: dict[str, str] = {"sha1": "sha1", "sha256": "sha256", "md5": "md5"}
"""Names of checksums in the protocol, and in hashlib. They find errors of transmission and nothing else."""
_DIGITS = 15


class Checksum(NamedTuple):
    """What a part's bytes are to be: the name of a hash, and its value."""

    algorithm: str
    digest: bytes

    def of(self, blocks: Any) -> bool:
        """Whether bytes have it."""
        found = hashlib.new(ALGORITHMS[self.algorithm], usedforsecurity=False)
        for block in blocks:
            found.update(block)
        return found.digest() == self.digest


def check_version(request: Request) -> None:
    """Refuse other versions of the protocol.

    Raises
    ------
    UnsupportedVersion
    """
    version = request.headers.get("tus-resumable")
    if version != VERSION:
        raise UnsupportedVersion(
            f"the version of tus is {version[:20] if version else 'missing'}",
            field="Tus-Resumable",
            limit=VERSION,
            cure=f"send the header Tus-Resumable: {VERSION}",
        )


def read_number(request: Request, name: str) -> int:
    """A header that is a number of bytes.

    Raises
    ------
    MalformedRequest
        It is missing, or no such number.
    """
    text = request.headers.get(name, "")
    if not (text.isascii() and text.isdigit() and len(text) <= _DIGITS):
        raise MalformedRequest(f"{name} is missing or no number", field=name, limit="digits", cure="send it in bytes")
    return int(text)


def read_metadata(request: Request) -> dict[str, bytes]:
    """The header Upload-Metadata.

    Raises
    ------
    MalformedRequest
        It is no list of keys with values in Base64, or has a key twice.
    """
    found: dict[str, bytes] = {}
    for entry in request.headers.get("upload-metadata", "").split(","):
        name, _, value = entry.strip().partition(" ")
        if not name:
            continue
        try:
            decoded = base64.b64decode(value, validate=True)
        except binascii.Error as error:
            raise _bad_metadata(f"the value of {name[:40]} is no Base64") from error
        if name in found:
            raise _bad_metadata(f"{name[:40]} is there twice")
        found[name] = decoded
    return found


def read_checksum(request: Request) -> Checksum | None:
    """The header Upload-Checksum, if it was sent.

    Raises
    ------
    MalformedRequest
        Its algorithm is not known, or its value is no Base64.
    """
    text = request.headers.get("upload-checksum")
    if text is None:
        return None
    name, _, value = text.partition(" ")
    try:
        digest = base64.b64decode(value, validate=True)
    except binascii.Error:
        digest = b""
    if name not in ALGORITHMS or not digest:
        raise MalformedRequest(
            "Upload-Checksum cannot be read",
            field="Upload-Checksum",
            limit=", ".join(ALGORITHMS),
            cure="send the name of the algorithm, a space and the digest in Base64",
        )
    return Checksum(name, digest)


def described(document: UploadDocument) -> dict[str, str]:
    """Headers that describe an upload."""
    headers = {
        "Tus-Resumable": VERSION,
        "Upload-Offset": str(document["received"]),
        "Upload-Length": str(document["length"]),
        "Cache-Control": "no-store",
    }
    if document["state"] == "open":
        headers["Upload-Expires"] = format_datetime(document["expires_at"], usegmt=True)
    if "decode_id" in document:
        headers["Waymark-Decode"] = f"/v1/decodes/{document['decode_id']}"
    return headers


def options(max_bytes: int) -> Mapping[str, str]:
    """The versions and extensions of tus that the server supports."""
    return {
        "Tus-Resumable": VERSION,
        "Tus-Version": VERSION,
        "Tus-Extension": EXTENSIONS,
        "Tus-Max-Size": str(max_bytes),
        "Tus-Checksum-Algorithm": ",".join(ALGORITHMS),
    }


def _bad_metadata(message: str) -> MalformedRequest:
    return MalformedRequest(
        message, field="Upload-Metadata", limit="key Base64, key Base64", cure="encode each value in Base64"
    )
