"""What the texts of the public pages are, in any language; `texts_en` and `texts_de` have them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from app.markers.status import Status
from app.services.public_pages.documents import ReportKind


@dataclass(frozen=True, slots=True)
class Texts:
    """All texts of the public pages in one language.

    Attributes
    ----------
    language, name : str
        Its tag (RFC 5646), and what it calls itself.
    decimal_point : str
    statuses, kinds, faults : mapping
        Statuses of markers, kinds of damage, and what is wrong with a form, by `forms.Fault`.
    problems : mapping of int to (str, str)
        Title and text of error pages by status; 0 is any other.
    """

    language: str
    name: str
    decimal_point: str
    marker: str
    code: str
    agency: str
    status: str
    revision: str
    road: str
    measure: str
    statuses: Mapping[Status, str]
    report: str
    report_intro: str
    kind: str
    kinds: Mapping[ReportKind, str]
    text: str
    text_hint: str
    photo: str
    photo_hint: str
    email: str
    email_hint: str
    leave_empty: str
    optional: str
    required: str
    send: str
    error_prefix: str
    errors_title: str
    faults: Mapping[str, str]
    photo_again: str
    thanks: str
    thanks_text: str
    back: str
    problems: Mapping[int, tuple[str, str]]
