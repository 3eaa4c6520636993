"""The public pages as HTML: no script and no inline style, so that the content security policy can refuse both.

Whatever is inserted passes through `escape`; the texts do, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from fastapi import Response
from starlette.datastructures import Headers
from starlette.types import Scope

from app.api.public_pages.texts import LANGUAGES, Texts, is_public_page, texts_for, wants_json
from app.services.public_pages.pages import PublicMarker, ReportKind

MAX_TEXT = 1000
"""Characters of a description."""
MAX_EMAIL = 254
"""Characters of an address (RFC 5321, section 4.5.3.1.3, without the angle brackets)."""


@dataclass(frozen=True, slots=True)
class FormState:
    """A form as it is shown.

    Attributes
    ----------
    token : str
    photo_mb, contact_days : int
        Limits that the hints name. [MB, d]
    values : mapping
        What was typed before, by field.
    faults : mapping
        What is wrong, by field; the key of a text and what it names.
    """

    token: str
    photo_mb: int
    contact_days: int
    values: Mapping[str, str]
    faults: Mapping[str, str]
    had_photo: bool = False


def marker_page(texts: Texts, marker: PublicMarker, form: FormState | None, *, up: str = "") -> str:
    """The page of a marker.

    Parameters
    ----------
    form : FormState or None
        None: the agency takes no reports.
    up : str
        Relative address of the page's folder, from where it is shown.
    """
    facts = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in _facts(texts, marker)
    )
    title = texts.marker if marker.agency is None else f"{texts.marker} – {marker.agency}"
    report = "" if form is None else _report(texts, marker, form, up)
    summary = "" if form is None else _summary(texts, form)
    if form is not None and form.faults:
        title = f"{texts.error_prefix}: {title}"
    body = f'{summary}<h1>{escape(texts.marker)}</h1>\n<dl class="facts">{facts}</dl>\n{report}'
    return _page(texts, title, body, here=f"{up}{marker.id}", up=up)


def thanks_page(texts: Texts, marker: PublicMarker) -> str:
    """The page after a report was received."""
    back = f"../{marker.id}?lang={texts.language}"
    body = (
        f"<h1>{escape(texts.thanks)}</h1>\n<p>{escape(texts.thanks_text)}</p>\n"
        f'<p><a class="button" href="{escape(back)}">{escape(texts.back)}</a></p>'
    )
    return _page(texts, texts.thanks, body, here="thanks", up="../")


def problem_page(texts: Texts, status: int, depth: int) -> str:
    """The page for an error: the same for every cause with this status."""
    title, text = texts.problems.get(status, texts.problems[0])
    return _page(texts, title, f"<h1>{escape(title)}</h1>\n<p>{escape(text)}</p>", here="", up="../" * depth)


def _facts(texts: Texts, marker: PublicMarker) -> Sequence[tuple[str, str]]:
    measure = None if marker.measure_m is None else f"{marker.measure_m:.1f} m".replace(".", texts.decimal_point)
    found = (
        (texts.code, marker.code),
        (texts.agency, marker.agency),
        (texts.status, texts.statuses[marker.status] if marker.status is not None else None),
        (texts.revision, None if marker.revision is None else str(marker.revision)),
        (texts.road, marker.road),
        (texts.measure, measure),
    )
    return [(name, value) for name, value in found if value is not None]


def _page(texts: Texts, title: str, body: str, *, here: str, up: str) -> str:
    others = " ".join(
        f'<a href="{escape(here)}?lang={other.language}" lang="{other.language}" hreflang="{other.language}">'
        f"{escape(other.name)}</a>"
        for other in LANGUAGES.values()
        if other is not texts
    )
    static = f"{up}../static"
    return f"""<!doctype html>
<html lang="{texts.language}">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta name="robots" content="noindex">
<title>{escape(title)}</title>
<link rel="icon" href="{static}/favicon.svg" type="image/svg+xml">
<link rel="stylesheet" href="{static}/public.css">
</head>
<body>
<header><span class="brand">Waymark</span> <nav>{others}</nav></header>
<main>
{body}
</main>
</body>
</html>
"""


# --- the form -----------------------------------------------------------------------------------------------------


def _report(texts: Texts, marker: PublicMarker, form: FormState, up: str) -> str:
    action = f"{up}{marker.id}/reports?lang={texts.language}"
    parts = (
        _kinds(texts, form),
        _text(texts, form),
        _photo(texts, form),
        _email(texts, form),
        _honeypot(texts, form),
    )
    return f"""<section aria-labelledby="report">
<h2 id="report">{escape(texts.report)}</h2>
<p>{escape(texts.report_intro)}</p>
<form method="post" action="{escape(action)}" enctype="multipart/form-data" novalidate>
<input type="hidden" name="token" value="{escape(form.token)}">
{"".join(parts)}
<p><button type="submit">{escape(texts.send)}</button></p>
</form>
</section>"""


def _summary(texts: Texts, form: FormState) -> str:
    """What is wrong, before everything else; it gets the focus."""
    if not form.faults:
        return ""
    places = {"kind": "kind-damaged", "token": "send"}
    lines = "".join(
        f"<li>{escape(text)}</li>"
        if field == "token"
        else f'<li><a href="#{places.get(field, field)}">{escape(text)}</a></li>'
        for field, text in form.faults.items()
    )
    again = f"<p>{escape(texts.photo_again)}</p>" if form.had_photo else ""
    return (
        f'<div class="problem" role="alert" tabindex="-1" autofocus><h2>{escape(texts.errors_title)}</h2>'
        f"<ul>{lines}</ul>{again}</div>\n"
    )


def _kinds(texts: Texts, form: FormState) -> str:
    choices = "".join(_choice(kind, text, form) for kind, text in texts.kinds.items())
    described = ' aria-describedby="kind-fault"' if "kind" in form.faults else ""
    required = f'<span class="soft">({escape(texts.required)})</span>'
    return (
        f"<fieldset{described}><legend>{escape(texts.kind)} {required}</legend>"
        f"{_fault('kind', form)}{choices}</fieldset>"
    )


def _choice(kind: ReportKind, text: str, form: FormState) -> str:
    checked = " checked" if form.values.get("kind") == kind else ""
    return (
        f'<label class="choice"><input type="radio" id="kind-{kind}" name="kind" value="{kind}" required{checked}> '
        f"<span>{escape(text)}</span></label>"
    )


def _text(texts: Texts, form: FormState) -> str:
    hint = texts.text_hint.format(limit=MAX_TEXT)
    area = (
        f'<textarea id="text" name="text" rows="4" maxlength="{MAX_TEXT}"{_described("text", form)}>\n'
        f"{escape(form.values.get('text', ''))}</textarea>"
    )
    return _field(texts, form, "text", texts.text, hint, area)


def _photo(texts: Texts, form: FormState) -> str:
    hint = texts.photo_hint.format(limit=form.photo_mb)
    choose = f'<input type="file" id="photo" name="photo" accept="image/jpeg,image/png"{_described("photo", form)}>'
    return _field(texts, form, "photo", texts.photo, hint, choose)


def _email(texts: Texts, form: FormState) -> str:
    hint = texts.email_hint.format(days=form.contact_days)
    line = (
        f'<input type="email" id="email" name="email" autocomplete="email" maxlength="{MAX_EMAIL}"'
        f' value="{escape(form.values.get("email", ""))}"{_described("email", form)}>'
    )
    return _field(texts, form, "email", texts.email, hint, line)


def _honeypot(texts: Texts, form: FormState) -> str:
    """A field that only programs fill in: it is neither shown nor reached by the keyboard, unless it was filled in."""
    hidden = "" if "website" in form.faults else ' class="trap" aria-hidden="true"'
    value = escape(form.values.get("website", ""))
    return (
        f'<div{hidden}><label for="website">{escape(texts.leave_empty)}</label>{_fault("website", form)}'
        f'<input type="text" id="website" name="website" tabindex="-1" autocomplete="off" value="{value}"></div>'
    )


def _field(texts: Texts, form: FormState, name: str, label: str, hint: str, control: str) -> str:
    return (
        f'<div class="field"><label for="{name}">{escape(label)} <span class="soft">({escape(texts.optional)})</span>'
        f'</label><p class="soft" id="{name}-hint">{escape(hint)}</p>{_fault(name, form)}{control}</div>'
    )


def _described(name: str, form: FormState) -> str:
    if name in form.faults:
        return f' aria-invalid="true" aria-describedby="{name}-hint {name}-fault"'
    return f' aria-describedby="{name}-hint"'


def _fault(name: str, form: FormState) -> str:
    if name not in form.faults:
        return ""
    return f'<p class="fault" id="{name}-fault">{escape(form.faults[name])}</p>'


# === What all responses to requests for public pages have in common; problems are pages there, too.


_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; style-src 'self'; img-src 'self'; form-action 'self'; base-uri 'none'; "
        "frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Robots-Tag": "noindex",
    "Vary": "Accept, Accept-Language",
}


def page_response(page: str | Response, texts: Texts | None = None, status: int = 200) -> Response:
    """A page, or another response, with the headers of public pages."""
    response = Response(page, status, media_type="text/html") if isinstance(page, str) else page
    response.headers.update(_HEADERS)
    if texts is not None:
        response.headers["Content-Language"] = texts.language
    return response


def as_page(problem: Response, scope: Scope) -> Response:
    """A problem document as a page, where a public page was asked for by a client that does not prefer JSON."""
    if not is_public_page(scope):
        return problem
    if wants_json(Headers(scope=scope)):
        return page_response(problem)
    texts = texts_for(scope)
    depth = max(0, scope["path"].count("/") - 2)
    page = page_response(problem_page(texts, problem.status_code, depth), texts, problem.status_code)
    for name in ("Retry-After", "Connection", "Allow"):
        if name in problem.headers:
            page.headers[name] = problem.headers[name]
    return page
