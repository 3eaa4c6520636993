"""The use cases of the server and of `waymark worker`: app/wiring.py makes them, and routes ask for them by name."""

from __future__ import annotations

from dataclasses import dataclass

from app.services.access.access import Access
from app.services.access.audit import AuditLog
from app.services.access.audit_jobs import AuditVerifications
from app.services.access.keys import Agencies, Keys
from app.services.blobs import UnusedBlobs
from app.services.decodes.decodes import DecodeDetails, Decodes
from app.services.decodes.outputs import DecodeOutputs
from app.services.drives.drives import Drives
from app.services.fleet.calibrations import Calibrations
from app.services.fleet.snapshots import Snapshots
from app.services.fleet.vehicles import Vehicles
from app.services.health.maintenance import Maintenance
from app.services.jobs import Jobs
from app.services.markers.artwork import ArtworkJobs, Artworks
from app.services.markers.bulk import BulkMarkers
from app.services.markers.codebooks import Codebooks
from app.services.markers.features import Features
from app.services.markers.markers import Markers, Observations
from app.services.markers.plate_drafts import PlateDrafts
from app.services.markers.print_grades import PrintGrades
from app.services.markers.programs import CerpmPrograms, Layouts
from app.services.markers.searches import Searches
from app.services.plans.alignments import Alignments
from app.services.plans.making import PlanMaking, PlanPreviews
from app.services.plans.packages import Packages
from app.services.plans.plans import Plans
from app.services.plans.proofs import Proofs
from app.services.progress import AgencyEvents, AllJobs, JobFiles
from app.services.public_pages.pages import FormTokens, PublicPages
from app.services.public_pages.reports import DamageReports
from app.services.reprocessing import Reprocessings
from app.services.roads.roads import Roads
from app.services.surveys.exports import ExportJobs, Exports
from app.services.surveys.import_jobs import ImportJobs
from app.services.surveys.imports import Imports
from app.services.uploads.quotas import Quotas
from app.services.uploads.uploads import Uploads
from app.services.webhooks import WebhookDelivery, Webhooks


@dataclass(frozen=True, slots=True, kw_only=True)
class UseCases:
    """All use cases. A route asks for one with `app.api.http.dependencies.use_case`."""

    # permissions, keys and the audit log
    access: Access
    agencies: Agencies
    audit: AuditLog
    audit_verifications: AuditVerifications
    keys: Keys
    vehicles: Vehicles

    # the registry: markers, roads and codebooks, and what is read of them
    bulk_markers: BulkMarkers
    codebooks: Codebooks
    features: Features
    layouts: Layouts
    maintenance: Maintenance
    markers: Markers
    observations: Observations
    programs: CerpmPrograms
    roads: Roads
    searches: Searches
    snapshots: Snapshots

    # surveys, at once and as jobs
    imports: Imports
    import_jobs: ImportJobs

    # artwork, prints and cameras
    artworks: Artworks
    calibrations: Calibrations
    plate_drafts: PlateDrafts
    print_grades: PrintGrades

    # uploads and what is decoded of them
    decode_details: DecodeDetails
    decode_outputs: DecodeOutputs
    decodes: Decodes
    drives: Drives
    reprocessings: Reprocessings
    unused_blobs: UnusedBlobs
    uploads: Uploads

    # roads to plan and their plans
    alignments: Alignments
    packages: Packages
    plan_making: PlanMaking
    plan_previews: PlanPreviews
    plans: Plans
    proofs: Proofs

    # jobs of every kind, and those that write files
    all_jobs: AllJobs
    artwork_jobs: ArtworkJobs
    export_jobs: ExportJobs
    exports: Exports
    job_files: JobFiles

    # events and the webhooks that deliver them
    agency_events: AgencyEvents
    webhook_delivery: WebhookDelivery
    webhooks: Webhooks

    # the pages that need no key
    damage_reports: DamageReports
    form_tokens: FormTokens
    public_pages: PublicPages

    # jobs of all kinds, and what agencies may store
    jobs: Jobs
    quotas: Quotas
