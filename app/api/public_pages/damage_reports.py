"""/v1/damage-reports and /v1/public-page: what people reported, the agency's decisions, and what it releases."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path, Query, Request, Response
from pydantic import ConfigDict, Field

from app.api.health import RejectionIn
from app.api.http.dependencies import Caller, LastId, PageSize, Version, use_case
from app.api.http.permissions import ADMINS, READERS, SURVEYORS
from app.api.http.problems import problem_responses
from app.api.http.responses import (
    NOT_MODIFIED,
    IfNoneMatch,
    document_response,
    file_response,
    json_response,
    page_response,
    versioned_response,
)
from app.api.http.routes import Router
from app.inputs import Flag, Identifier, StrictModel, Text
from app.services.public_pages.pages import (
    DamageReport,
    DamageReportPage,
    PublicField,
    PublicPageDocument,
    PublicPages,
    ReportContact,
    ReportStatus,
)
from app.services.public_pages.reports import DamageReports

router = Router("/v1/damage-reports", "public pages")

ReportId = Annotated[Identifier, Path(description="Id of the report.")]
Service = Annotated[DamageReports, use_case(lambda cases: cases.damage_reports)]
_PHOTO_HEADERS = {"Content-Security-Policy": "default-src 'none'; sandbox"}


class ReportApprovalIn(StrictModel):
    """What the crew should know."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"note": "seen by the patrol"}, {}]})

    note: Text | None = Field(default=None, min_length=1, max_length=300)


@router.get("", READERS, responses=document_response(DamageReportPage))
def list_damage_reports(
    request: Request,
    caller: Caller,
    reports: Service,
    status: Annotated[ReportStatus | None, Query(description="Of the reports; without it, all.")] = None,
    marker_id: Annotated[Identifier | None, Query(description="Id of a marker.")] = None,
    limit: PageSize = 100,
    after: LastId = None,
) -> Response:
    """List the damage reports of an agency.

    Newest first.
    """
    page, last = reports.page(caller, status=status, marker_id=marker_id, before=after, limit=limit)
    return page_response(request, page, after=last)


@router.get("/{report_id}", READERS, responses=document_response(DamageReport, 404))
def get_damage_report(report_id: ReportId, caller: Caller, reports: Service) -> Response:
    """Get a damage report."""
    return json_response(reports.get(caller, report_id))


@router.get("/{report_id}/photo", READERS, responses={**file_response(["image/jpeg"]), **problem_responses(404)})
def get_damage_photo(report_id: ReportId, caller: Caller, reports: Service) -> Response:
    """Get the photo of a damage report.

    A JPEG that was written again, without metadata.
    """
    return Response(reports.photo(caller, report_id), headers=_PHOTO_HEADERS, media_type="image/jpeg")


@router.delete("/{report_id}/photo", SURVEYORS, status_code=204, responses=problem_responses(404))
def delete_damage_photo(report_id: ReportId, caller: Caller, reports: Service) -> Response:
    """Delete the photo of a damage report.

    Such as one that shows people. The report stays.
    """
    reports.delete_photo(caller, report_id)
    return Response(status_code=204)


# an e-mail address is for those who decide
@router.get("/{report_id}/contact", SURVEYORS, responses=document_response(ReportContact, 404))
def get_report_contact(report_id: ReportId, caller: Caller, reports: Service) -> Response:
    """Get the e-mail address in a damage report.

    Its sender left it for questions.
    """
    return json_response(reports.contact(caller, report_id))


@router.delete("/{report_id}/contact", SURVEYORS, status_code=204, responses=problem_responses(404))
def delete_report_contact(report_id: ReportId, caller: Caller, reports: Service) -> Response:
    """Delete the e-mail address in a damage report.

    The report stays.
    """
    reports.delete_contact(caller, report_id)
    return Response(status_code=204)


@router.post("/{report_id}/approve", SURVEYORS, responses=document_response(DamageReport, 404, 409))
def approve_damage_report(
    approval: ReportApprovalIn, report_id: ReportId, caller: Caller, reports: Service
) -> Response:
    """Approve a damage report into the work list.

    In `/v1/maintenance` it is a new item, or the open one of the same marker.

    The marker does not change; that is decided with the item.
    """
    return json_response(reports.approve(caller, report_id, approval.note))


@router.post("/{report_id}/reject", SURVEYORS, responses=document_response(DamageReport, 404, 409))
def reject_damage_report(rejection: RejectionIn, report_id: ReportId, caller: Caller, reports: Service) -> Response:
    """Reject a damage report with a reason."""
    return json_response(reports.reject(caller, report_id, rejection.reason))


# === /v1/public-page: what an agency releases on the public pages of its markers.


settings_router = Router("/v1/public-page", "public pages")

Pages = Annotated[PublicPages, use_case(lambda cases: cases.public_pages)]


class PublicPageIn(StrictModel):
    """What is released."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {"fields": ["code", "agency", "status", "revision", "road", "measure"], "damage_reports": True},
                {"fields": [], "damage_reports": False},
            ]
        }
    )

    fields: list[PublicField] = Field(
        max_length=6, description="Fields of markers that everybody may see; none: the markers have no public pages."
    )
    damage_reports: Flag = Field(description="Whether the pages have a form for damage reports.")


@settings_router.get("", READERS, responses={**NOT_MODIFIED, **document_response(PublicPageDocument)})
def get_public_page_settings(caller: Caller, pages: Pages, if_none_match: IfNoneMatch = None) -> Response:
    """Get what an agency releases on its public pages."""
    return versioned_response(pages.settings(caller), if_none_match)


@settings_router.put("", ADMINS, responses=document_response(PublicPageDocument, 412, 428))
def put_public_page_settings(settings: PublicPageIn, caller: Caller, pages: Pages, version: Version) -> Response:
    """Change what an agency releases on its public pages.

    Other fields, or none. It holds at once, for the pages of all its markers.
    """
    return versioned_response(pages.change(caller, settings.fields, settings.damage_reports, version))
