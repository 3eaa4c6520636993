"""The family of square fiducial signs: ArUco and AprilTag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Literal

import numpy as np
import sqlalchemy as sa
from pydantic import BaseModel, ConfigDict, Field, JsonValue
from typing_extensions import TypedDict

from app.decoders.fiducial import FiducialReading, decode_fiducials
from app.decoding.declarations import CoarsePosition
from app.decoding.frames import Match, Nearby, Pixels, nearest_match, plate_heading_in_vehicle_deg
from app.encoders.fiducial import FiducialOrder, encode_fiducial, prove_fiducial
from app.encoders.plate import ArtworkOptions, Drawing, PlateReader
from app.errors import CodeTaken, InvalidParameter, WaymarkError, naming
from app.families.documents import (
    POSITION_EXAMPLE,
    Headed,
    MarkerDocument,
    MarkerIn,
    PositionIn,
    marker_head,
    marker_place,
    place_input,
    position_columns,
)
from app.families.family import (
    ArtworkProof,
    Family,
    FrameReader,
    Registration,
    map_point,
    rounded,
)
from app.families.surveys import (
    RETIRED,
    ColumnValues,
    MarkerRules,
    RowCodes,
    Rows,
    SurveyImport,
    is_placed_again,
    listed_codes,
)
from app.formats.surveys.roles import CodeForm
from app.formats.surveys.table import Fault
from app.geodesy import PlacedPosition
from app.geodesy.frames import distance_m
from app.inputs import Number, StrictModel, Text
from app.markers.fiducial import FiducialCode, FiducialGeometry, KnownFiducial, Mounting, SignImage, get_dictionary
from app.markers.reading import MarkerRow, PlatePose
from app.planning.outputs.hd_map import MapMarker
from app.registry import markers as store
from app.registry.bulk_load import Columns
from app.registry.marker_rows import CodeRow
from app.sensors.camera import Camera
from app.surveys.georeference import GeoreferencedSurvey

# === Schemas of requests that register fiducial signs.


class FiducialGeometryIn(StrictModel):
    """Dimensions and mounting of a sign."""

    side_mm: Number = Field(description="Outer edge of the black border, 30 to 3000. [mm]")
    quiet_mm: Number | None = Field(
        None, description="White zone round the border; as wide as a module if left out, at most 1000. [mm]"
    )
    mounting: Mounting = Field(
        Mounting.UPRIGHT,
        description="Facing the traffic, or flat on the road with its upper edge in the direction of travel.",
    )

    image: SignImage | None = Field(
        None,
        description="Whose image of an AprilTag the sign shows the right way up: OpenCV's, which the artwork here has, "
        "or that of AprilTag's authors, which is turned by 180 degrees.",
    )

    def of_code(self, code: FiducialCode) -> FiducialGeometry:
        """The dimensions of a sign with a code, all of them.

        Raises
        ------
        InvalidParameter
            A dimension is outside its limits, or there is only one image of this code.
        """
        if self.image is SignImage.APRILTAG and not code.has_two_images:
            raise InvalidParameter(
                f"AprilTag's authors publish no image of {code.dictionary}",
                field="geometry.image",
                limit="opencv",
                cure="leave it out",
            )
        module_mm = self.side_mm / (get_dictionary(code.dictionary).modules + 2)
        with naming("geometry"):
            quiet_mm = module_mm if self.quiet_mm is None else self.quiet_mm
            return FiducialGeometry(self.side_mm, quiet_mm, self.mounting, self.image)


FIDUCIAL_EXAMPLES: list[JsonValue] = [
    {
        "family": "fiducial",
        "position": POSITION_EXAMPLE,
        "code": {"dictionary": "apriltag-36h11", "number": 17},
        "geometry": {"side_mm": 400, "mounting": "upright"},
        "heading_deg": 78.5,
        "status": "surveyed",
    }
]


class FiducialIn(Headed, MarkerIn):
    """An ArUco or AprilTag sign to register; its position is that of the sign's centre."""

    model_config = ConfigDict(json_schema_extra={"examples": FIDUCIAL_EXAMPLES})

    family: Literal["fiducial"]
    position: PositionIn
    code: FiducialCode
    geometry: FiducialGeometryIn


# === Fiducial signs as clients see them.


class FiducialCodeDocument(TypedDict):
    """The code of a sign: the dictionary, the codeword's number, and both in words."""

    scheme: str
    text: str
    dictionary: str
    number: int


class FiducialDocument(MarkerDocument):
    """An ArUco or AprilTag sign."""

    family: Literal["fiducial"]
    code: FiducialCodeDocument
    geometry: FiducialGeometry


def fiducial_document(row: MarkerRow) -> FiducialDocument:
    """A sign's row as clients see it."""
    return {
        **marker_head(row),
        "family": "fiducial",
        "code": {
            "scheme": row.scheme,
            "text": row.digits,
            "dictionary": row.scheme,
            "number": int(row.digits.rpartition("-")[2]),
        },
        "geometry": row.spec,
        **marker_place(row),
    }


# === The row of a fiducial sign as values of the core.


def fiducial_code(row: MarkerRow) -> FiducialCode:
    """Code of a sign's row."""
    return FiducialCode.from_text(row.digits, row.scheme)


def fiducial_geometry(row: MarkerRow) -> FiducialGeometry:
    """Dimensions and mounting of a sign's row."""
    spec = row.spec
    image = SignImage(spec["image"]) if spec.get("image") else None
    return FiducialGeometry(spec["side_mm"], spec["quiet_mm"], Mounting(spec["mounting"]), image)


def known_fiducial(row: MarkerRow) -> KnownFiducial:
    """A sign's row as a decoder expects it."""
    return KnownFiducial(fiducial_code(row), fiducial_geometry(row))


# === Fiducial signs in camera frames: what is looked for, which registered sign a reading is of, and its document.


@dataclass(frozen=True, slots=True)
class FiducialSearch:
    """What to look for in a frame: the signs that the registry has nearby, with the camera."""

    known: tuple[KnownFiducial, ...]
    camera: Camera | None = None


class FiducialReadingDocument(TypedDict):
    """A candidate sign in a frame and what was read from it."""

    family: Literal["fiducial"]
    outcome: str
    reason: str | None
    digits: str | None
    scheme: str | None
    confidence: float
    bit_errors: int
    contrast: float
    corners_px: list[list[float]]
    side_px: float
    pose: PlatePose | None
    turned_deg: Annotated[
        int | None,
        Field(
            description="Clockwise by which OpenCV's image stands turned on the sign: as it is seen of an upright "
            "sign, as it is registered of a lying one; null where it is not known. [deg]"
        ),
    ]


class FiducialFrames(FrameReader[FiducialReading, FiducialSearch]):
    """Reads fiducial signs in frames, where the registry has some nearby."""

    document_type = FiducialReadingDocument

    def search(self, nearby: Nearby, camera: Camera | None) -> FiducialSearch | None:
        """The signs nearby; None without any: looking for them takes as long as looking for plates."""
        known = tuple(dict.fromkeys(known_fiducial(row) for row in nearby.rows))
        return FiducialSearch(known, camera) if known else None

    def read(self, pixels: Pixels, search: FiducialSearch, *, thermal: bool) -> Sequence[FiducialReading]:
        """Decode the signs of a frame; thermal frames show none."""
        return [] if thermal else decode_fiducials(pixels, known=search.known, camera=search.camera)

    def match(
        self,
        connection: sa.Connection,
        agency_id: str,
        reading: FiducialReading,
        position: CoarsePosition | None,
        nearby: Nearby,
    ) -> Match | None:
        """The registered sign with the code that was read, nearest to the approximate position."""
        code = reading.code
        if code is None or position is None:
            return None
        rows = [row for row in nearby.rows if fiducial_code(row).text == code.text]
        if rows:
            return nearest_match(rows, position, "fiducial sign")
        return Match(None, note="no sign of this agency nearby carries this code")

    def document(self, reading: FiducialReading) -> FiducialReadingDocument:
        """A reading as clients see it."""
        code = reading.code
        return {
            "family": "fiducial",
            "outcome": str(reading.outcome),
            "reason": reading.reason or None,
            "digits": code.text if code else None,
            "scheme": code.dictionary if code else None,
            "confidence": float(reading.confidence),
            "bit_errors": int(reading.bit_errors),
            "contrast": round(float(reading.contrast), 1),
            "corners_px": rounded(reading.corners_px, 3) or [],
            "side_px": round(float(reading.side_px), 2),
            "pose": reading.pose,
            "turned_deg": reading.turned_deg,
        }

    def orient(
        self, reading: FiducialReading, match: Match, camera: Camera, heading_deg: float | None
    ) -> tuple[FiducialReading, str]:
        """A lying AprilTag of which it is not stated whose image it shows: the vehicle's heading decides."""
        row, pose = match.row, reading.pose
        if row is None or row.heading_deg is None or pose is None or reading.turned_deg is not None:
            return reading, ""
        if heading_deg is None:
            return reading, (
                "the sign lies on the road, and it is not stated whose image of the AprilTag it shows: the position "
                "may be on the other side of it; register geometry.image, or send heading_deg"
            )
        by_opencv_deg = (row.heading_deg - plate_heading_in_vehicle_deg(pose, camera) - heading_deg) % 360.0
        if not 90.0 < by_opencv_deg < 270.0:
            return replace(reading, turned_deg=0), ""
        pose = replace(pose, rotation=pose.rotation * np.array([-1.0, -1.0, 1.0]))
        corners_px = np.roll(reading.corners_px, 2, axis=0)
        return replace(reading, pose=pose, corners_px=corners_px, turned_deg=180), ""

    def observation(self, reading: FiducialReading) -> dict[str, object]:
        """Confidence and errors."""
        return {"confidence": float(reading.confidence), "bit_errors": int(reading.bit_errors)}


# === Surveys of fiducial signs.


class SignIn(StrictModel):
    """What the signs of a survey have in common."""

    dictionary: Text = Field(max_length=40, description="Such as `apriltag-36h11`.")
    geometry: FiducialGeometryIn


class FiducialSurveyIn(BaseModel):
    """Members of a survey's declaration that fiducial signs have."""

    sign: SignIn | None = Field(None, description="Of fiducial signs; the column `code` has their numbers.")


class FiducialSurvey(SurveyImport[KnownFiducial | None]):
    """Points that become fiducial signs of one dictionary and size; each row names its number."""

    members = FiducialSurveyIn

    def defaults(self, declared: Mapping[str, object]) -> KnownFiducial | None:
        """Any sign of the declared dictionary and dimensions."""
        if declared.get("sign") is None:
            return None
        sign = SignIn.model_validate(declared["sign"])
        with naming("sign"):
            code = FiducialCode(sign.dictionary, 0)
            return KnownFiducial(code, sign.geometry.of_code(code))

    def code_form(self, defaults: KnownFiducial | None, *, compare: bool) -> CodeForm:
        """Numbers, with or without the series of the dictionary."""
        return CodeForm("(?:[^ ]+-)?[0-9]{1,5}", False, "numbers of signs")

    def read_codes(
        self, survey: GeoreferencedSurvey, rows: Rows, defaults: KnownFiducial | None
    ) -> tuple[RowCodes, list[Fault]]:
        """Numbers of the dictionary.

        Raises
        ------
        InvalidParameter
            No dictionary is declared.
        """
        dictionary = _declared(defaults).code.dictionary
        digits, faults = np.zeros(len(rows), dtype="S64"), list[Fault]()
        for k, text in listed_codes(survey, rows):
            try:
                digits[k] = FiducialCode.from_text(text, dictionary).text.encode()
            except WaymarkError as error:
                faults.append(Fault(int(rows[k]) + 1, "code", "not_a_marker", error.message, error.cure))
        named = {fault.row for fault in faults}
        for k in np.flatnonzero(digits == b"").tolist():
            if int(rows[k]) + 1 not in named:
                message, cure = "a sign needs its number", "add a column with the role code"
                faults.append(Fault(int(rows[k]) + 1, "code", "not_a_marker", message, cure))
        good = digits != b""
        return RowCodes(rows, digits, good.copy(), dictionary).of(good), faults

    def is_unique(self, codes: RowCodes) -> bool:
        """Signs with the same code may stand far apart."""
        return False

    def collides(
        self,
        codes: RowCodes,
        defaults: KnownFiducial | None,
        place: tuple[float, float],
        known: CodeRow,
        agency_id: str,
        rules: MarkerRules,
    ) -> bool:
        """With a sign nearby that has the same code."""
        if known.status == RETIRED:
            return False
        return distance_m(*place, known.lon_deg, known.lat_deg) <= rules.position_code_radius_m

    def columns(self, survey: GeoreferencedSurvey, codes: RowCodes, defaults: KnownFiducial | None) -> Columns:
        """Dictionary and dimensions."""
        same = {"scheme": codes.scheme, "spec": asdict(_declared(defaults).geometry)}
        return Columns(len(codes.rows), same, {})


def _declared(defaults: KnownFiducial | None) -> KnownFiducial:
    if defaults is None:
        raise InvalidParameter(
            "the dictionary and the size of the signs are not declared",
            field="declaration.sign",
            limit="dictionary and geometry",
            cure="declare sign with both",
        )
    return defaults


# === The family of fiducial signs: ArUco and AprilTag signs that agencies have in use.


class Fiducials(Family[FiducialIn, PlacedPosition]):
    """The family of fiducial signs."""

    name = "fiducial"
    label = "fiducial sign"
    title = "Fiducial signs"
    schema = FiducialIn
    examples = FIDUCIAL_EXAMPLES
    artwork_version = "fiducial/2"
    survey = FiducialSurvey()
    frames = FiducialFrames()
    document_type = FiducialDocument
    detail_type = FiducialDocument

    def prepare(self, registration: Registration, new: FiducialIn) -> PlacedPosition:
        """The sign's place in WGS 84."""
        return place_input(new.position, registration.rules.crs_accuracy_m)

    def columns(
        self, connection: sa.Connection, registration: Registration, new: FiducialIn, prepared: PlacedPosition
    ) -> ColumnValues:
        """Code, dimensions and place.

        Raises
        ------
        CodeTaken
            Another sign nearby carries the code.
        """
        _check_free(connection, registration, new.code.text, prepared.lon_deg, prepared.lat_deg)
        return {
            "family": self.name,
            "scheme": new.code.dictionary,
            "digits": new.code.text,
            "heading_deg": new.heading_deg,
            "spec": asdict(new.geometry.of_code(new.code)),
            **position_columns(new.position, prepared),
        }

    def revise(
        self, connection: sa.Connection, registration: Registration, row: MarkerRow, values: ColumnValues
    ) -> ColumnValues:
        """Nothing changes but the place, where the code must be free.

        Raises
        ------
        CodeTaken
            At its new place, or back in use, another sign nearby carries the code.
        """
        if is_placed_again(row, values):
            merged = row._replace(**values)
            _check_free(connection, registration, row.digits, merged.lon_deg, merged.lat_deg, row.id)
        return {}

    def feature_members(self, properties: Mapping[str, object]) -> dict[str, object]:
        """Refuse a point: its properties do not say how large the sign is."""
        raise InvalidParameter(
            "a sign needs the size of its border, which a point does not have",
            field="properties.family",
            limit="families whose markers are points",
            cure="register signs at /v1/markers",
        )

    def document(self, row: MarkerRow) -> FiducialDocument:
        """A sign."""
        return fiducial_document(row)

    def map_markers(self, row: MarkerRow) -> Sequence[MapMarker]:
        """The square of its border, upright or on the road."""
        geometry = fiducial_geometry(row)
        upright = geometry.mounting is Mounting.UPRIGHT
        return (map_point(row, kind=row.scheme, side_m=geometry.side_mm / 1000, upright=upright),)

    def draw(self, row: MarkerRow, options: ArtworkOptions, *, record_url: str) -> Drawing:
        """The drawing of a sign.

        Raises
        ------
        InvalidParameter
            Heaters or light sources are asked for: signs have none.
        """
        if options.heaters or options.leds:
            raise InvalidParameter(
                "signs have no heaters and no light sources",
                field="heaters" if options.heaters else "leds",
                limit="plates only",
                cure="leave it out",
            )
        order = FiducialOrder(row.id, fiducial_code(row), fiducial_geometry(row), record_url, row.version)
        return encode_fiducial(order)

    def prove(self, row: MarkerRow, drawing: Drawing, read_plates: PlateReader) -> ArtworkProof:
        """Read a sign back with OpenCV's detector, which gives no confidence but right or wrong."""
        code = fiducial_code(row)
        prove_fiducial(drawing, code, fiducial_geometry(row))
        return ArtworkProof(code.text, 1.0)

    def snapshot_kind(self, row: MarkerRow) -> dict[str, object]:
        """Dictionary, dimensions and mounting; `app.decoders.fiducial` reads signs on board."""
        return {"scheme": row.scheme, **row.spec}


FIDUCIAL = Fiducials()


def _check_free(
    connection: sa.Connection,
    registration: Registration,
    text: str,
    lon_deg: float,
    lat_deg: float,
    ignoring: str | None = None,
) -> None:
    """Refuse a code that another sign nearby carries: a vehicle between them could not say which one it sees."""
    radius_m = registration.rules.position_code_radius_m
    other = store.find_code_near(
        connection, text, lon_deg, lat_deg, radius_m, mismatched_radius_m=radius_m, ignoring=ignoring
    )
    if other is None:
        return
    own = other.agency_id == registration.agency_id
    raise CodeTaken(
        f"the code {text} is taken by {'marker ' + other.id if own else 'a marker of another agency'}",
        field="code.number",
        limit=f"no two signs with the same code within {radius_m:g} m",
        cure="choose another number, or retire the other sign",
    )
