"""Settings of the server and the command line, read from `WAYMARK_*` by the entry points, never at import."""

from __future__ import annotations

import ipaddress
import re
from pathlib import Path
from typing import Literal, Self
from urllib.parse import urlsplit

from pydantic import Field, SecretStr, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

MIN_ADMIN_KEY_CHARACTERS = 24
_TILE = ("{z}", "{x}", "{y}")
_LOOPBACK = ("http://127.0.0.1:", "http://localhost:", "http://[::1]:")


class Settings(BaseSettings):
    """All settings. The defaults run the embedded server on a new machine."""

    model_config = SettingsConfigDict(env_prefix="WAYMARK_", frozen=True, extra="ignore", env_ignore_empty=True)

    data_dir: Path = Field(default=Path("var"), description="Folder for the embedded database and the uploads.")
    database_url: str = Field(
        default="",
        repr=False,
        description="sqlite:///PATH, or postgresql+psycopg://USER@HOST/DATABASE with PostGIS; empty: an SQLite file "
        "in the data folder.",
    )
    blobs_url: str = Field(
        default="", description="file:///FOLDER or s3://BUCKET/PREFIX; empty: a folder in the data folder."
    )
    spool_dir: Path | None = Field(
        default=None,
        description="Folder for bodies while they arrive, on the disk of the blobs; empty: in the data folder.",
    )
    blobs_shared: bool = Field(
        default=False, description="Whether the folder of `blobs_url` is one that the server and all workers share."
    )
    broker_url: str = Field(
        default="",
        repr=False,
        description="amqp://USER:PASSWORD@HOST:PORT/VHOST of RabbitMQ, whose queues `waymark worker` takes jobs from; "
        "empty: the server runs the jobs itself.",
    )
    broker_prefix: str = Field(
        default="waymark",
        pattern=r"^[A-Za-z0-9_-]{1,100}$",
        description="First part of the names of the broker's queues.",
    )
    secrets_dir: Path | None = Field(
        default=None,
        description="Folder with settings that are secret, each in a file of its name in small letters "
        "(`waymark_database_url`), and with `aws_access_key_id` and `aws_secret_access_key`.",
    )
    host: str = Field(default="127.0.0.1", description="Address to listen on.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen on.")
    public_url: str = Field(
        default="",
        max_length=100,
        description="Address at which clients reach the server, http://... or https://...; used in QR codes and links. "
        "Artwork has no QR code without it, or with an address of this machine only.",
    )
    guide_dir: Path | None = Field(
        default=None, description="Folder with the built guide, which is shown at /guide; empty: that of `make docs`."
    )
    master_key_file: Path | None = Field(
        default=None, description="File with the 32 bytes that encrypt the agencies' secret keys; created if missing."
    )
    signing_key_file: Path | None = Field(
        default=None,
        description="File with the one or two Ed25519 keys (32 bytes each) of snapshots; created if missing.",
    )
    admin_key: SecretStr | None = Field(
        default=None, description="Admin key of the server; without it, one is generated for an empty database."
    )

    max_json_bytes: int = Field(default=1024**2, ge=1024, description="Maximum size of a JSON body. [byte]")
    max_upload_bytes: int = Field(default=32 * 1024**2, ge=1024, description="Maximum size of an upload. [byte]")
    max_resumable_bytes: int = Field(
        default=4 * 1024**3, ge=1024, description="Maximum size of a file that is uploaded in parts. [byte]"
    )
    upload_expiry_h: float = Field(
        default=24.0, gt=0, description="Time after its last part in which an upload in parts has to go on. [h]"
    )
    key_stored_bytes: int = Field(
        default=2**38, ge=0, description="Maximum size of all stored uploads of one key; 0: unlimited. [byte]"
    )
    agency_stored_bytes: int = Field(
        default=2**40, ge=0, description="Maximum size of all stored uploads of one agency; 0: unlimited. [byte]"
    )
    key_open_uploads: int = Field(
        default=16, ge=0, description="Maximum number of uploads in parts of one key at a time; 0: unlimited."
    )
    agency_open_uploads: int = Field(
        default=256, ge=0, description="Maximum number of uploads in parts of one agency at a time; 0: unlimited."
    )
    max_import_bytes: int = Field(
        default=256 * 1024**2, ge=1024, description="Maximum size of a survey to import. [byte]"
    )
    max_image_pixels: int = Field(default=50_000_000, ge=1, description="Maximum size of a picture. [px]")
    header_timeout_s: float = Field(
        default=10.0, gt=0, description="Maximum time from the first byte of a request to the end of its headers. [s]"
    )
    body_timeout_s: float = Field(
        default=30.0, gt=0, description="Maximum time to wait for the next part of a body. [s]"
    )
    min_bytes_per_s: float = Field(
        default=8000.0,
        gt=0,
        description="Minimum rate at which bodies arrive and responses are read, after the first `body_timeout_s`. "
        "[byte/s]",
    )
    keep_alive_s: int = Field(default=20, ge=1, description="Maximum time between two requests on one connection. [s]")
    max_connections: int = Field(default=1000, ge=1, description="Maximum number of connections at a time.")
    max_connections_per_address: int = Field(
        default=200, ge=1, description="Maximum number of connections at a time from one address."
    )
    max_archive_frames: int = Field(
        default=500, ge=1, le=10_000, description="Maximum number of frames in one archive."
    )
    decode_memory_bytes: int = Field(
        default=1_280_000_000, ge=2**29, description="Maximum private memory of a decoder process. [byte]"
    )
    decode_timeout_s: float = Field(default=20.0, gt=0, description="Maximum time to decode one frame. [s]")
    trace_timeout_s: float = Field(default=300.0, gt=0, description="Maximum time to decode one recording. [s]")
    decode_workers: int = Field(default=2, ge=1, le=256, description="Number of decoder processes.")
    warm_decoders: bool = Field(
        default=True, description="Start the decoder processes with the server, not with the first upload."
    )

    explicit_code_radius_m: float = Field(
        default=20_000.0, ge=0, le=1e6, description="Minimum distance between plates with the same chosen digits. [m]"
    )
    position_code_radius_m: float = Field(
        default=1_000.0, ge=0, le=1e6, description="Minimum distance between position plates with the same digits. [m]"
    )
    crs_accuracy_m: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="Maximum stated error of a coordinate transformation that is used; other positions are unfit. [m]",
    )
    proj_grids_dir: Path | None = Field(
        default=None, description="Folder with PROJ grids for coordinate transformations; none are downloaded."
    )
    idempotency_ttl_h: float = Field(
        default=24.0, gt=0, description="Time for which the response to an Idempotency-Key is stored. [h]"
    )

    requests_per_s: float = Field(
        default=200.0,
        ge=0,
        le=1e6,
        description="Maximum rate of requests with one key in the long run; 0: unlimited. [1/s]",
    )
    requests_at_once: int = Field(
        default=1000, ge=1, le=1_000_000, description="Maximum number of requests with one key in a burst."
    )
    wrong_keys_per_minute: float = Field(
        default=30.0, ge=0, le=1e6, description="Maximum rate of wrong keys from one address; 0: unlimited. [1/min]"
    )

    public_pages_per_minute: float = Field(
        default=60.0,
        ge=0,
        le=1e6,
        description="Maximum rate of requests for public pages from one address; one without a page counts as five; 0: "
        "unlimited. [1/min]",
    )
    damage_reports_per_hour: float = Field(
        default=10.0, ge=0, le=1e6, description="Maximum rate of damage reports from one address; 0: unlimited. [1/h]"
    )
    marker_reports_per_day: float = Field(
        default=20.0, ge=0, le=1e6, description="Maximum rate of damage reports of one marker; 0: unlimited. [1/d]"
    )
    max_report_photo_bytes: int = Field(
        default=16_000_000, ge=1_000_000, description="Maximum size of the photo in a damage report. [byte]"
    )
    report_contact_days: int = Field(
        default=90,
        ge=1,
        le=3650,
        description="Time after which e-mail addresses of damage reports are deleted. [d]",
    )

    trusted_proxies: str = Field(
        default="",
        description="Addresses of proxies whose X-Forwarded-For and X-Forwarded-Proto are accepted, separated by "
        "commas; empty: none.",
    )
    key_processor_s_per_min: float = Field(
        default=120.0,
        ge=0,
        le=1e6,
        description="Processor time for requests with one key in the long run; ten minutes' worth at once; 0: "
        "unlimited. [s/min]",
    )
    agency_processor_s_per_min: float = Field(
        default=240.0,
        ge=0,
        le=1e6,
        description="Processor time for requests of one agency, in the same way. [s/min]",
    )
    expensive_at_once: int = Field(
        default=4, ge=1, le=1000, description="Maximum number of expensive requests at once; others wait."
    )
    expensive_per_agency: int = Field(
        default=2, ge=1, le=1000, description="Maximum number of expensive requests of one agency at once."
    )
    request_timeout_s: float = Field(
        default=300.0, gt=0, description="Maximum time for the work on a request that is not a job. [s]"
    )

    oidc_issuer: str = Field(default="", description="OpenID Connect issuer whose tokens are accepted; empty: none.")
    oidc_audience: str = Field(default="", description="Audience that its tokens must contain.")
    oidc_jwks: str = Field(default="", description="Its public keys (JWKS): https://..., or a file.")
    oidc_agency_claim: str = Field(default="waymark_agency", description="Claim that names the agency.")
    oidc_scope_claim: str = Field(default="waymark_scope", description="Claim that names the scope.")

    oidc_client_id: str = Field(
        default="",
        description="Client of the web pages at the issuer (public, authorization code with PKCE); empty: the pages "
        "ask for a key.",
    )
    oidc_authorize_url: str = Field(default="", description="The issuer's authorization endpoint, for the pages.")
    oidc_token_url: str = Field(default="", description="The issuer's token endpoint, for the pages.")
    oidc_request_scopes: str = Field(
        default="openid profile", description="OAuth scopes that the pages request, separated by spaces."
    )

    base_map: str = Field(
        default="",
        description="Map under the markers on the pages: a PMTiles file on the server, or the URL of raster tiles with "
        "{z}, {x} and {y}; empty: a grid.",
    )
    base_map_attribution: str = Field(default="", description="Attribution that the base map requires.")

    webhooks_to_loopback: bool = Field(
        default=False, description="Webhooks may be sent to this machine, also by http: for trying them out."
    )

    worker_metrics_port: int = Field(
        default=0, ge=0, le=65535, description="Port on which a worker answers /metrics and /healthz; 0: none."
    )
    otlp_endpoint: str = Field(
        default="",
        description="URL of an OpenTelemetry collector for traces (OTLP over HTTP), e.g. http://collector:4318; empty: "
        "none. Needs the extra `tracing`.",
    )
    log_format: Literal["console", "json"] = Field(
        default="console", description="Format of log lines: console or json."
    )
    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR"] = Field(
        default="INFO", description="Lowest level that is logged: DEBUG, INFO, WARNING or ERROR."
    )

    @field_validator("admin_key")
    @classmethod
    def _long_enough(cls, key: SecretStr | None) -> SecretStr | None:
        if key is not None and len(key.get_secret_value()) < MIN_ADMIN_KEY_CHARACTERS:
            raise ValueError(f"an admin key has at least {MIN_ADMIN_KEY_CHARACTERS} characters")
        return key

    @field_validator("public_url")
    @classmethod
    def _is_an_address(cls, url: str) -> str:
        parts = urlsplit(url)
        if url and not (
            parts.scheme in ("http", "https")
            and parts.hostname
            and url.isascii()
            and url.isprintable()
            and not re.search(r"[\s?#]", url)
        ):
            raise ValueError("public_url must be http://HOST[:PORT][/PATH] or https://..., in printable ASCII")
        return url

    @field_validator("trusted_proxies")
    @classmethod
    def _are_addresses(cls, addresses: str) -> str:
        for address in addresses.split(","):
            if address.strip():
                ipaddress.ip_address(address.strip())
        return addresses

    @field_validator("proj_grids_dir")
    @classmethod
    def _is_folder(cls, folder: Path | None) -> Path | None:
        if folder is not None and not folder.is_dir():
            raise ValueError(f"{folder} is not a folder")
        return folder

    @field_validator("base_map")
    @classmethod
    def _is_map(cls, base_map: str) -> str:
        if not base_map:
            return base_map
        if base_map.endswith(".pmtiles"):
            if "://" in base_map or not Path(base_map).is_file():
                raise ValueError(f"{base_map} is not a PMTiles file of this machine")
        elif not (base_map.startswith(("https://", "/", *_LOOPBACK)) and all(p in base_map for p in _TILE)):
            raise ValueError("base_map is a .pmtiles file, or an https URL with {z}, {x} and {y}")
        elif any(character in base_map for character in " ;,'\""):
            raise ValueError("the URL of a base_map has no spaces, quotes, commas or semicolons")
        return base_map

    @model_validator(mode="after")
    def _whole_client(self) -> Self:
        if self.oidc_client_id and not self.oidc_issuer:
            raise ValueError("an oidc_client_id needs an oidc_issuer")
        for name in ("oidc_authorize_url", "oidc_token_url"):
            url = getattr(self, name)
            if self.oidc_client_id and not url.startswith(("https://", *_LOOPBACK)):
                raise ValueError(f"an oidc_client_id needs an {name}, by https")
            if any(character in url for character in " ;,'\""):
                raise ValueError(f"{name} has no spaces, quotes, commas or semicolons")
        return self

    @model_validator(mode="after")
    def _supported_database(self) -> Self:
        if self.database_url and not self.database_url.startswith(("sqlite:///", "postgresql+psycopg://")):
            raise ValueError("database_url must be sqlite:///PATH or postgresql+psycopg://USER@HOST/DATABASE")
        return self

    @model_validator(mode="after")
    def _shared_stores(self) -> Self:
        if not self.broker_url:
            return self
        if not self.broker_url.startswith(("amqp://", "amqps://")):
            raise ValueError("broker_url must be amqp://USER:PASSWORD@HOST:PORT/VHOST or amqps://...")
        if not self.database_url.startswith("postgresql+psycopg://"):
            raise ValueError(
                "workers cannot share an SQLite file: set WAYMARK_DATABASE_URL=postgresql+psycopg://... as well, or "
                "unset WAYMARK_BROKER_URL"
            )
        if not (self.blobs_url.startswith("s3://") or self.blobs_shared):
            raise ValueError(
                "workers read the uploads: set WAYMARK_BLOBS_URL=s3://..., or WAYMARK_BLOBS_SHARED=true if all of them "
                "have the same folder"
            )
        return self

    @model_validator(mode="after")
    def _whole_issuer(self) -> Self:
        if self.oidc_issuer and not (self.oidc_audience and self.oidc_jwks):
            raise ValueError("an oidc_issuer needs an oidc_audience and oidc_jwks")
        if self.oidc_jwks.startswith("http://") and not self.oidc_jwks.startswith(_LOOPBACK):
            raise ValueError("oidc_jwks is fetched by https")
        return self

    @property
    def base_map_file(self) -> Path | None:
        """The base map's file, if it is one."""
        return Path(self.base_map).resolve() if self.base_map.endswith(".pmtiles") else None

    @property
    def proxies(self) -> list[str]:
        """The addresses of trusted proxies."""
        return [address.strip() for address in self.trusted_proxies.split(",") if address.strip()]

    @property
    def resolved_database_url(self) -> str:
        """Database URL with the default filled in."""
        return self.database_url or f"sqlite:///{self.data_dir / 'waymark.sqlite3'}"

    @property
    def is_embedded(self) -> bool:
        """Whether database and blobs are files, which no other server uses."""
        return self.resolved_database_url.startswith("sqlite:") and self.resolved_blobs_url.startswith("file:")

    @property
    def resolved_blobs_url(self) -> str:
        """URL of the blob store with the default filled in."""
        return self.blobs_url or (self.data_dir.resolve() / "blobs").as_uri()

    @property
    def resolved_spool_dir(self) -> Path:
        """Folder of arriving bodies with the default filled in."""
        return self.spool_dir or self.data_dir / "spool"

    @property
    def resolved_master_key_file(self) -> Path:
        """File of the server's key with the default filled in."""
        return self.master_key_file or self.data_dir / "master.key"

    @property
    def resolved_signing_key_file(self) -> Path:
        """File of the keys of snapshots with the default filled in."""
        return self.signing_key_file or self.data_dir / "signing.key"

    @property
    def qr_code_url(self) -> str:
        """Start of the addresses in QR codes, without a trailing slash; empty if only this machine could open them."""
        host = urlsplit(self.public_url).hostname or "localhost"
        return "" if _is_this_machine(host) else self.public_url.rstrip("/")


def _is_this_machine(host: str) -> bool:
    """Whether an address leads each machine to itself."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")
    return address.is_loopback or address.is_unspecified
