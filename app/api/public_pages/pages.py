"""/m/{marker_id}: what everybody may see of a marker, and the form for damage reports. Neither needs a key."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, cast

from anyio import to_thread
from fastapi import Depends, Path, Query, Request, Response

from app.api.http.bodies import FORM, received_form
from app.api.http.dependencies import use_case
from app.api.http.permissions import PUBLIC
from app.api.http.problems import problem_responses
from app.api.http.responses import BINARY, json_response
from app.api.http.routes import Router
from app.api.public_pages.forms import (
    FIELDS,
    KINDS,
    MAX_FIELD_BYTES,
    MEGABYTE,
    Fault,
    FormRefused,
    PublicLimits,
    ReportForm,
    check_form,
    photo_fault,
    read_form,
)
from app.api.public_pages.html import MAX_EMAIL, MAX_TEXT, FormState, marker_page, page_response, thanks_page
from app.api.public_pages.texts import ENGLISH, Texts, texts_for, wants_json
from app.errors import InvalidParameter, NotFound, ProcessStopped, UnreadableUpload
from app.services.public_pages.pages import (
    MAX_AGE_S,
    MIN_AGE_S,
    FormTokens,
    PublicMarker,
    PublicMarkerDocument,
    PublicPages,
    ReceivedReport,
    TokenRefused,
    TokenTooYoung,
)
from app.services.public_pages.pages import ReportForm as ReportFormDocument
from app.services.public_pages.reports import DamageReports
from app.values import JsonObject

router = Router("/m", "public pages")


@dataclass(frozen=True, slots=True)
class FormLimits:
    """Limits that the form names: size of the photo [byte], and days until contacts are deleted."""

    photo_bytes: int
    contact_days: int

    @property
    def photo_mb(self) -> int:
        """[MB]"""
        return self.photo_bytes // MEGABYTE


MarkerAddress = Annotated[str, Path(description="Id of the marker, as the QR code on the plate has it.")]
Lang = Annotated[str | None, Query(description="`en` or `de`; otherwise Accept-Language decides.")]


async def get_public_limits(request: Request) -> PublicLimits:
    """How often the pages may be asked for."""
    limits: PublicLimits = request.app.state.public_limits
    return limits


async def get_form_limits(request: Request) -> FormLimits:
    """What a damage report may hold."""
    limits: FormLimits = request.app.state.form_limits
    return limits


Pages = Annotated[PublicPages, use_case(lambda cases: cases.public_pages)]
Reports = Annotated[DamageReports, use_case(lambda cases: cases.damage_reports)]
Tokens = Annotated[FormTokens, use_case(lambda cases: cases.form_tokens)]
Limits = Annotated[PublicLimits, Depends(get_public_limits)]
Form = Annotated[FormLimits, Depends(get_form_limits)]

_HTML: JsonObject = {"text/html": {"schema": {"type": "string"}}}


def _described(status: int, description: str, model: type | None = None) -> dict[int | str, JsonObject]:
    """A page that is HTML, or JSON if there is a model; every problem is HTML or JSON."""
    page: JsonObject = {"description": description, "content": _HTML}
    if model is not None:
        page["model"] = model
    problems = problem_responses(404, 405)
    return {status: page, **{code: {**one, "content": {**one["content"], **_HTML}} for code, one in problems.items()}}


_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            FORM: {
                "schema": {
                    "type": "object",
                    "required": ["kind", "token"],
                    "properties": {
                        "kind": {"type": "string", "enum": list(KINDS)},
                        "text": {"type": "string", "maxLength": MAX_TEXT, "description": "What is wrong."},
                        "photo": {**BINARY, "description": "JPEG or PNG; stored as a new JPEG, without metadata."},
                        "email": {"type": "string", "maxLength": MAX_EMAIL, "description": "For questions; optional."},
                        "website": {"type": "string", "maxLength": 0, "description": "To be left empty."},
                        "token": {"type": "string", "description": "`report.token` of the marker's page."},
                    },
                    "additionalProperties": False,
                },
                "example": {"kind": "loose", "text": "one corner stands up", "token": "..."},
            }
        },
    }
}


@router.get("/{marker_id}", PUBLIC, responses=_described(200, "What the agency releases", PublicMarkerDocument))
async def get_public_page(
    request: Request, marker_id: MarkerAddress, pages: Pages, tokens: Tokens, limits: Limits, form: Form,
    lang: Lang = None,
) -> Response:  # fmt: skip
    """Get the public page of a marker.

    The public page of a marker: HTML, or JSON with `Accept: application/json`. It needs no key.

    It shows what the marker's agency releases. Where there is no such marker, or its agency releases nothing, the
    response is the same 404.
    """
    limits.take_page(request)
    marker = await _read(request, marker_id, pages, limits)
    token = tokens.issue(marker.id) if marker.takes_reports else None
    if wants_json(request.headers):
        return page_response(json_response(_document(marker, token)))
    texts = texts_for(request.scope)
    state = None if token is None else FormState(token, form.photo_mb, form.contact_days, {}, {})
    return page_response(marker_page(texts, marker, state), texts)


@router.get("/{marker_id}/thanks", PUBLIC, responses=_described(200, "A report was received"))
async def get_thanks(
    request: Request, marker_id: MarkerAddress, pages: Pages, limits: Limits, lang: Lang = None
) -> Response:
    """Get the page that confirms a damage report."""
    limits.take_page(request)
    texts = texts_for(request.scope)
    return page_response(thanks_page(texts, await _read(request, marker_id, pages, limits)), texts)


@router.post(
    "/{marker_id}/reports",
    PUBLIC,
    status_code=201,
    openapi_extra=_BODY,
    responses={
        **_described(201, "Received"),
        201: {"model": ReceivedReport, "description": "Received"},
        303: {"description": "Received, for a client that does not prefer JSON: Location is a page that confirms it"},
    },
)
async def post_damage_report(
    request: Request, marker_id: MarkerAddress, pages: Pages, reports: Reports, tokens: Tokens, limits: Limits,
    form: Form, lang: Lang = None,
) -> Response:  # fmt: skip
    """Report damage of a marker, without a key.

    Staff of the agency decides on it.

    A form is sent at the earliest three seconds and at the latest six hours after its token was made. One that is sent
    twice is one report.
    """
    limits.take_report(request)
    marker = await _read(request, marker_id, pages, limits)
    if not marker.takes_reports:
        raise NotFound("there is no public page here")
    check_form(request)
    async with received_form(request, max_files=1, max_fields=len(FIELDS), max_part_size=MAX_FIELD_BYTES) as parts:
        sent = await read_form(parts)
        texts = texts_for(request.scope)
        try:
            await _submit(marker, sent, reports, tokens, limits, form, texts.language)
        except FormRefused as refused:
            return _refused(request, texts, marker, sent, refused.faults, tokens, form)
    if wants_json(request.headers):
        return page_response(json_response(ReceivedReport(status="received"), 201))
    return page_response(Response(status_code=303, headers={"Location": f"thanks?lang={texts.language}"}))


async def _read(request: Request, marker_id: str, pages: PublicPages, limits: PublicLimits) -> PublicMarker:
    try:
        return await to_thread.run_sync(pages.read, marker_id)
    except NotFound:
        limits.charge_miss(request)
        raise


async def _submit(
    marker: PublicMarker, sent: ReportForm, reports: DamageReports, tokens: FormTokens, limits: PublicLimits,
    form: FormLimits, language: str,
) -> None:  # fmt: skip
    """Check and store a report."""
    report = sent.checked(marker.id, tokens, language)
    if report.photo is not None and report.photo.size > form.photo_bytes:
        raise FormRefused(Fault("photo", "photo-large", form.photo_mb))
    limits.take_report_of(marker.id)
    try:
        await to_thread.run_sync(reports.submit, marker, report)
    except (ProcessStopped, UnreadableUpload) as error:
        raise FormRefused(photo_fault(error, form.photo_mb)) from error


def _refused(
    request: Request, texts: Texts, marker: PublicMarker, sent: ReportForm, faults: tuple[Fault, ...],
    tokens: FormTokens, form: FormLimits,
) -> Response:  # fmt: skip
    """The form again with what was typed and what is wrong; with its token, unless that has expired."""
    if wants_json(request.headers):
        first, *others = (_as_error(fault, form) for fault in faults)
        first.parts = tuple(others)
        raise first
    token = sent.values["token"]
    try:
        tokens.check(marker.id, token)
    except TokenTooYoung:
        pass
    except TokenRefused:
        token = tokens.issue(marker.id)
    state = FormState(
        token, form.photo_mb, form.contact_days, sent.values,
        {fault.field: fault.text(texts) for fault in faults}, sent.photo is not None,
    )  # fmt: skip
    return page_response(marker_page(texts, marker, state, up="../"), texts, 422)


def _as_error(fault: Fault, form: FormLimits) -> InvalidParameter:
    limits = {
        "kind": ", ".join(KINDS),
        "text": f"at most {MAX_TEXT} characters; needed for the kind other, or a photo",
        "email": "an e-mail address, or nothing",
        "photo": f"a JPEG or PNG of at most {form.photo_bytes} bytes",
        "website": "empty",
        "token": f"a token of this marker's page, {MIN_AGE_S} s to {MAX_AGE_S} s old",
    }
    return InvalidParameter(fault.text(ENGLISH), field=fault.field, limit=limits[fault.field])


def _document(marker: PublicMarker, token: str | None) -> PublicMarkerDocument:
    names = ("code", "agency", "status", "revision", "road", "measure_m")
    shown: JsonObject = {name: value for name in names if (value := getattr(marker, name)) is not None}
    report: ReportFormDocument | None = None
    if token is not None:
        report = {
            "href": f"/m/{marker.id}/reports", "token": token, "kinds": list(KINDS), "min_age_s": MIN_AGE_S,
            "max_age_s": MAX_AGE_S,
        }  # fmt: skip
    return cast("PublicMarkerDocument", {**shown, "report": report})
