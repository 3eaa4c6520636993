"""The public pages in German."""

from __future__ import annotations

from app.api.public_pages.texts import Texts

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
    measure="Stationierung",
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
