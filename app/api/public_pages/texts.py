"""Texts of the public pages in English and German, and the language that a client wants."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from starlette.datastructures import Headers, QueryParams
from starlette.types import Scope

from app.markers.reading import Status
from app.services.public_pages.pages import ReportKind


@dataclass(frozen=True, slots=True)
class Texts:
    """All texts of the public pages in one language."""

    # `language`, `name`: its tag (RFC 5646), and what it calls itself
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
    # `statuses`, `kinds`, `faults`: statuses of markers, kinds of damage, and what is wrong with a form, by
    # `forms.Fault`
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
    problems: Mapping[int, tuple[str, str]]  # title and text of error pages by status; 0 is any other


# === The public pages in German.


GERMAN = Texts(
    language="de",
    name="Deutsch",
    decimal_point=",",
    marker="Straßenmarker",
    code="Code",
    agency="Straßenverwaltung",
    status="Status",
    revision="Revision der Druckvorlage",
    road="Straße",
    measure="Straßenkilometer",
    statuses={
        "planned": "geplant",
        "built": "eingebaut",
        "surveyed": "eingemessen",
        "active": "in Betrieb",
        "suspect": "in Betrieb, wird überprüft",
        "retired": "außer Betrieb",
    },
    report="Schaden melden",
    report_intro="Stimmt etwas mit diesem Marker nicht? Melden Sie es der Straßenverwaltung. Bitte halten Sie dafür "
    "nicht auf der Straße an und betreten Sie sie nicht.",
    kind="Was stimmt nicht?",
    kinds={
        "damaged": "Der Marker ist beschädigt",
        "dirty": "Der Marker ist verschmutzt oder verdeckt",
        "missing": "Der Marker fehlt",
        "loose": "Der Marker ist lose",
        "other": "Etwas anderes",
    },
    text="Beschreibung",
    text_hint="Höchstens {limit} Zeichen.",
    photo="Foto",
    photo_hint="JPEG oder PNG, höchstens {limit} MB. Ort und Zeit, die im Foto gespeichert sind, werden entfernt. "
    "Bitte zeigen Sie keine Personen.",
    email="Ihre E-Mail-Adresse",
    email_hint="Nur für Rückfragen zu dieser Meldung. Die Straßenverwaltung löscht sie auf Ihren Wunsch und nach "
    "{days} Tagen.",
    leave_empty="Lassen Sie dieses Feld leer",
    optional="freiwillig",
    required="Pflichtangabe",
    send="Meldung senden",
    error_prefix="Fehler",
    errors_title="Die Meldung wurde nicht gesendet",
    faults={
        "kind-missing": "Wählen Sie aus, was nicht stimmt.",
        "text-missing": "Beschreiben Sie, was nicht stimmt, oder fügen Sie ein Foto hinzu.",
        "text-long": "Die Beschreibung hat {found} Zeichen. Kürzen Sie sie auf {limit}.",
        "email-wrong": "Das ist keine E-Mail-Adresse. Berichtigen Sie sie, oder lassen Sie das Feld leer.",
        "photo-large": "Das Foto ist größer als {limit} MB oder hat zu viele Pixel. Wählen Sie ein kleineres.",
        "photo-kind": "Die Datei ist kein Foto im Format JPEG oder PNG. Wählen Sie eine andere.",
        "photo-damaged": "Das Foto lässt sich nicht lesen. Wählen Sie ein anderes.",
        "website-filled": "Lassen Sie dieses Feld leer.",
        "token-expired": "Das Formular war zu lange geöffnet. Senden Sie es noch einmal.",
        "token-young": "Das Formular wurde sehr schnell gesendet. Warten Sie einige Sekunden und senden Sie es noch "
        "einmal.",
    },
    photo_again="Wählen Sie das Foto noch einmal aus: Browser behalten es nicht.",
    thanks="Vielen Dank",
    thanks_text="Die Meldung wurde an die Straßenverwaltung gesendet und wird dort geprüft.",
    back="Zurück zum Marker",
    problems={
        404: ("Seite nicht gefunden", "Unter dieser Adresse gibt es keine öffentliche Seite."),
        413: ("Zu groß", "Die Sendung ist zu groß. Senden Sie die Meldung mit einem kleineren Foto oder ohne Foto."),
        429: ("Zu viele Anfragen", "Warten Sie eine Weile und versuchen Sie es noch einmal."),
        503: ("Zurzeit nicht erreichbar", "Versuchen Sie es in einer Minute noch einmal."),
        507: ("Zurzeit nicht erreichbar", "Versuchen Sie es später noch einmal."),
        0: ("Die Anfrage kann nicht beantwortet werden", "Gehen Sie zurück und versuchen Sie es noch einmal."),
    },
)


# === The public pages in English.


ENGLISH = Texts(
    language="en",
    name="English",
    decimal_point=".",
    marker="Road marker",
    code="Code",
    agency="Road agency",
    status="Status",
    revision="Artwork revision",
    road="Road",
    measure="Kilometre of the road",
    statuses={
        "planned": "planned",
        "built": "installed",
        "surveyed": "surveyed",
        "active": "in use",
        "suspect": "in use, to be checked",
        "retired": "out of use",
    },
    report="Report damage",
    report_intro="Is something wrong with this marker? Tell the road agency. Please do not stop or walk on the road.",
    kind="What is wrong?",
    kinds={
        "damaged": "The marker is damaged",
        "dirty": "The marker is dirty or covered",
        "missing": "The marker is missing",
        "loose": "The marker is loose",
        "other": "Something else",
    },
    text="Description",
    text_hint="At most {limit} characters.",
    photo="Photo",
    photo_hint="JPEG or PNG, at most {limit} MB. Place and time stored in the photo are removed. Please show no "
    "people.",
    email="Your e-mail address",
    email_hint="Only for questions about this report. The agency deletes it when you ask, and after {days} days.",
    leave_empty="Leave this field empty",
    optional="optional",
    required="required",
    send="Send report",
    error_prefix="Error",
    errors_title="The report was not sent",
    faults={
        "kind-missing": "Choose what is wrong.",
        "text-missing": "Describe what is wrong, or add a photo.",
        "text-long": "The description has {found} characters. Shorten it to {limit}.",
        "email-wrong": "This is not an e-mail address. Correct it, or leave the field empty.",
        "photo-large": "The photo is larger than {limit} MB, or has too many pixels. Choose a smaller one.",
        "photo-kind": "The file is not a JPEG or PNG photo. Choose another one.",
        "photo-damaged": "The photo cannot be read. Choose another one.",
        "website-filled": "Leave this field empty.",
        "token-expired": "The form was open for too long. Send it again.",
        "token-young": "The form was sent very quickly. Wait a few seconds, then send it again.",
    },
    photo_again="Choose the photo again: browsers do not keep it.",
    thanks="Thank you",
    thanks_text="The report was sent to the road agency. Staff will look at it.",
    back="Back to the marker",
    problems={
        404: ("Page not found", "There is no public page at this address."),
        413: ("Too large", "What was sent is too large. Send the report with a smaller photo, or without one."),
        429: ("Too many requests", "Wait a while, then try again."),
        503: ("Not available at present", "Try again in a minute."),
        507: ("Not available at present", "Try again later."),
        0: ("The request cannot be answered", "Go back and try again."),
    },
)


# === What a client wants of a public page: HTML or JSON, and in which language (RFC 9110, section 12.5).


LANGUAGES = {texts.language: texts for texts in (ENGLISH, GERMAN)}
PREFIX = "/m/"
"""Start of the paths of public pages."""
_MAX_HEADER = 500
"""Characters of a header that are looked at. Browsers send about 100."""


def is_public_page(scope: Scope) -> bool:
    """Whether a request is for a public page."""
    return str(scope.get("path", "")).startswith(PREFIX)


def wants_json(headers: Headers) -> bool:
    """Whether a client prefers JSON to HTML; without a preference it gets HTML."""
    quality = {"application/json": 0.0, "text/html": 0.0}
    for name, q in _weighted(headers.get("accept", "")):
        if name in quality:
            quality[name] = max(quality[name], q)
        elif name in ("application/problem+json", "application/*"):
            quality["application/json"] = max(quality["application/json"], q)
        elif name == "text/*":
            quality["text/html"] = max(quality["text/html"], q)
    return quality["application/json"] > quality["text/html"]


def accepts_html(headers: Headers) -> bool:
    """Whether a client names HTML, as browsers do."""
    return any(name == "text/html" and q > 0 for name, q in _weighted(headers.get("accept", "")))


def texts_for(scope: Scope) -> Texts:
    """The texts in the language of the parameter `lang`, else the preferred one of Accept-Language, else English."""
    chosen = QueryParams(scope.get("query_string", b"")).get("lang", "")
    if chosen in LANGUAGES:
        return LANGUAGES[chosen]
    best, best_q = ENGLISH, 0.0
    for name, q in _weighted(Headers(scope=scope).get("accept-language", "")):
        texts = LANGUAGES.get(name.partition("-")[0])
        if texts is not None and q > best_q:
            best, best_q = texts, q
    return best


def _weighted(header: str) -> Iterator[tuple[str, float]]:
    """The members of a header with their weights; a weight that is none counts as 0."""
    for member in header[:_MAX_HEADER].lower().split(","):
        name, *parameters = (part.strip() for part in member.split(";"))
        weight = next((text[2:] for text in parameters if text.startswith("q=")), "1")
        try:
            q = float(weight)
        except ValueError:
            q = 0.0
        yield name, q if 0.0 <= q <= 1.0 else 0.0
