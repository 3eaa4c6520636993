"""Forms for damage reports: read, cleaned and checked, within limits for clients without a key."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from email.message import Message
from typing import NamedTuple, cast, get_args

from fastapi import Request
from starlette.datastructures import FormData, UploadFile

from app.api.http.bodies import FORM, SpooledPart, check_parts, media_type_of
from app.api.http.limits import RateLimit, address_of
from app.api.public_pages.html import MAX_EMAIL, MAX_TEXT
from app.api.public_pages.texts import Texts
from app.errors import InvalidParameter, MalformedRequest, UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.format import SpooledFile
from app.services.public_pages.pages import FormTokens, ReportKind, TokenRefused, TokenTooYoung
from app.services.public_pages.reports import SentReport

FIELDS = ("kind", "text", "photo", "email", "website", "token")
MAX_FIELD_BYTES = 16 * 1024
MEGABYTE = 1_000_000
KINDS = cast("tuple[ReportKind, ...]", get_args(ReportKind))
_EMAIL = re.compile(r"[^\s@<>\",;:\\()\[\]]+@[^\s@<>\"',;:\\()\[\]]+\.[^\s@<>\"',;:\\()\[\].]+")


class Fault(NamedTuple):
    """What is wrong with a field: the key of its text in `Texts.faults`, and the limit and finding that it names."""

    field: str
    key: str
    limit: int = 0
    found: int = 0

    def text(self, texts: Texts) -> str:
        """The fault in a language."""
        return texts.faults[self.key].format(limit=self.limit, found=self.found)


class FormRefused(Exception):
    """A form that the sender can correct."""

    def __init__(self, *faults: Fault) -> None:
        super().__init__(*faults)
        self.faults = faults


@dataclass(frozen=True, slots=True)
class ReportForm:
    """The parts of a form, without characters that no text contains."""

    values: Mapping[str, str]  # texts by field; empty where there is none
    photo: SpooledFile | None

    def checked(self, marker_id: str, tokens: FormTokens, language: str) -> SentReport:
        """The report that the form has.

        Raises
        ------
        FormRefused
            With everything that is wrong.
        """
        nonce, faults = "", list(self._faults())
        try:
            nonce = tokens.check(marker_id, self.values["token"])
        except TokenTooYoung:
            faults.append(Fault("token", "token-young"))
        except TokenRefused:
            faults.append(Fault("token", "token-expired"))
        if faults:
            raise FormRefused(*faults)
        values = self.values
        return SentReport(
            nonce,
            cast("ReportKind", values["kind"]),
            values["text"] or None,
            self.photo,
            values["email"] or None,
            language,
        )

    def _faults(self) -> Iterator[Fault]:
        values = self.values
        if values["kind"] not in KINDS:
            yield Fault("kind", "kind-missing")
        if len(values["text"]) > MAX_TEXT:
            yield Fault("text", "text-long", MAX_TEXT, len(values["text"]))
        if values["kind"] == "other" and not values["text"] and self.photo is None:
            yield Fault("text", "text-missing")
        if values["email"] and (len(values["email"]) > MAX_EMAIL or not _EMAIL.fullmatch(values["email"])):
            yield Fault("email", "email-wrong")
        if values["website"]:
            yield Fault("website", "website-filled")


def check_form(request: Request) -> None:
    """Refuse a request that is no form in UTF-8, before its body is read.

    Raises
    ------
    UnsupportedUpload
        It is not.
    """
    header = Message()
    header["content-type"] = request.headers.get("content-type", "")
    charset = header.get_content_charset("utf-8")
    if media_type_of(request) != FORM or charset != "utf-8":
        raise UnsupportedUpload(
            "a damage report is a form", field="Content-Type", limit=f"{FORM}, in UTF-8",
            cure="send the form of the marker's page",
        )  # fmt: skip


async def read_form(form: FormData) -> ReportForm:
    """The parts of a form.

    Raises
    ------
    MalformedRequest
        It has other parts, a part twice, a file in a text or a text as the photo.
    """
    check_parts(form, None, *FIELDS)
    values = {}
    for name in FIELDS:
        part = form.get(name, "")
        if name == "photo":
            continue
        if isinstance(part, UploadFile):
            raise MalformedRequest(f"the part {name} is a file", field=name, limit="a text", cure="send it as a text")
        values[name] = _cleaned(part, lines=name == "text")
    return ReportForm(values, _photo(form))


def _photo(form: FormData) -> SpooledFile | None:
    part = form.get("photo")
    if isinstance(part, SpooledPart):
        return part.spooled if part.spooled.size else None  # browsers send an empty part where no file was chosen
    if part:
        raise MalformedRequest("the photo came as text", field="photo", limit="a file", cure="send it with a file name")
    return None


def _cleaned(text: str, *, lines: bool) -> str:
    """A text without control characters, direction overrides and halves of surrogate pairs; line ends are \\n."""
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    kept = "\n\t" if lines else ""
    return "".join(c for c in text if c in kept or unicodedata.category(c) not in ("Cc", "Cf", "Cs")).strip()


def photo_fault(error: UnreadableUpload | InvalidParameter, photo_mb: int) -> Fault:
    """What is wrong with a photo."""
    if isinstance(error, UploadTooLarge):
        return Fault("photo", "photo-large", photo_mb)
    return Fault("photo", "photo-kind" if isinstance(error, UnsupportedUpload) else "photo-damaged")


# === Limits on requests without a key: pages and damage reports by address, damage reports by marker.


_MISS_COST = 5.0
"""Pages that an address which has no page counts as. Who follows a QR code asks for one."""
_CURE = "wait for the time in Retry-After"


@dataclass(frozen=True, slots=True)
class PublicLimits:
    """Token buckets; None: as many as they like. For the event loop only."""

    pages: RateLimit | None
    reports: RateLimit | None
    of_marker: RateLimit | None

    def take_page(self, request: Request) -> None:
        """Count a page.

        Raises
        ------
        TooManyRequests
            The address asked for too many.
        """
        if self.pages is not None:
            self.pages.take(_address(request))

    def charge_miss(self, request: Request) -> None:
        """Count an address without a page as several: nobody is to try many."""
        if self.pages is not None:
            self.pages.charge(_address(request), _MISS_COST - 1.0)

    def take_report(self, request: Request) -> None:
        """Count a damage report of an address, before its body is read.

        Raises
        ------
        TooManyRequests
            The address sent too many.
        """
        if self.reports is not None:
            self.reports.take(_address(request))

    def take_report_of(self, marker_id: str) -> None:
        """Count a damage report of a marker that is complete.

        Raises
        ------
        TooManyRequests
            Too many were sent.
        """
        if self.of_marker is not None:
            self.of_marker.take(marker_id)


def public_limits(pages_per_minute: float, reports_per_hour: float, of_marker_per_day: float) -> PublicLimits:
    """Limits from the settings; 0 is none. A minute's, an hour's and a day's worth may come at once."""
    return PublicLimits(
        _limit(pages_per_minute, 60.0, "pages", "too many pages were asked for from this address"),
        _limit(reports_per_hour, 3600.0, "reports", "too many damage reports were sent from this address"),
        _limit(of_marker_per_day, 86400.0, "marker-reports", "too many damage reports of this marker were sent"),
    )


def _limit(number: float, in_s: float, name: str, message: str) -> RateLimit | None:
    if not number:
        return None
    return RateLimit(number / in_s, max(1, round(number)), name=name, message=message, cure=_CURE)


def _address(request: Request) -> str:
    return address_of(request.client.host) if request.client else "unknown"
