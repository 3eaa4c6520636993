"""Sensor profiles: the part of a decode's context that stays the same from upload to upload.

A profile has the members of the context (`camera`, `thermal`, `thermal_range`, `trace`, `packets`) and their names.
What an upload states itself goes before its vehicle's profile, member by member.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from app.errors import InvalidParameter, naming
from app.formats.kinds import UploadKind
from app.services.decodes.context import CameraSetup, DecodeContext
from app.services.decodes.packet_task import packet_terms
from app.services.decodes.trace_task import trace_terms

FRAME, TRACE, PACKETS = (str(kind) for kind in UploadKind)
NEEDED = {FRAME: "camera", TRACE: "trace", PACKETS: "packets"}
"""Section that an upload of a kind cannot do without."""
SECTIONS = {
    FRAME: ("camera", "thermal", "thermal_range", "frames"),
    TRACE: ("trace",),
    PACKETS: ("packets", "camera"),
}
INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px")
_SIZE = ("width_px", "height_px")
_OF_THE_SIZE = (*INTRINSICS, "distortion")
_PROFILE_ONLY = ("calibration_id",)
"""What a vehicle's camera has and a context's has not."""
_WHOLE = ("trace.can.speed", "trace.can.heading")
"""Objects that are replaced as a whole: a signal by its name and one by its bits declare the same thing."""

Object = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Inherited:
    """A context after its vehicle's profile was put behind it.

    Attributes
    ----------
    context : dict
        As `DecodeContext.document` writes it, without what is nobody's.
    sources : dict of str to str
        Path of each member to ``upload``, ``vehicle`` or ``default``.
    """

    context: Object
    sources: dict[str, str]


def check_profile(profile: Mapping[str, Any]) -> None:
    """Refuse a profile that no upload could use.

    Raises
    ------
    InvalidParameter
        The field is below ``profile``.
    """
    with naming("profile"):
        camera = context_camera(profile.get("camera"))
        if camera is not None:
            # the mount alone is allowed: intrinsics can come from a calibration later
            known = camera if has_intrinsics(camera) else {**camera, "horizontal_fov_deg": 60.0}
            CameraSetup(**{**known, "distortion": tuple(known.get("distortion", ()))})
        counts = profile.get("thermal_range")
        DecodeContext(thermal=profile.get("thermal", False), thermal_range=(counts[0], counts[1]) if counts else None)
        if profile.get("trace") is not None:
            trace_terms(profile["trace"])
        if profile.get("packets") is not None:
            packet_terms(profile["packets"])


def has_intrinsics(camera: Mapping[str, Any]) -> bool:
    """Whether a camera states its projection, completely or in part."""
    return any(camera.get(name) is not None for name in (*INTRINSICS, "horizontal_fov_deg"))


def context_camera(camera: Mapping[str, Any] | None) -> Object | None:
    """A vehicle's camera as a context has it."""
    if camera is None:
        return None
    return {name: value for name, value in camera.items() if name not in _PROFILE_ONLY}


def inherit(profile: Mapping[str, Any], stated: Mapping[str, Any], kind: str) -> Inherited:
    """Complete what an upload states from the vehicle's profile.

    Parameters
    ----------
    profile : mapping
    stated : mapping
        Only what the upload states; a member that is None is unknown and is not inherited.
    kind : str
        ``frame``, ``trace`` or ``packets``: sections of other kinds are ignored.

    Raises
    ------
    InvalidParameter
        The profile's intrinsics belong to another frame size than the upload states.
    """
    ours = {name: profile[name] for name in SECTIONS[kind] if name in profile}
    stated_members = {name: value for name, value in stated.items() if value is not None or name not in NEEDED}
    if "camera" in ours:
        ours["camera"] = _fitting_camera(context_camera(ours["camera"]) or {}, stated_members.get("camera", {}))
        if kind != FRAME and not has_intrinsics({**ours["camera"], **(stated_members.get("camera") or {})}):
            del ours["camera"]  # a mount without a projection cannot draw over a frame
    if stated_members.get("thermal") is False:
        ours.pop("thermal_range", None)
    sources: dict[str, str] = {}
    context = _merge(ours, stated_members, sources)
    if isinstance(context.get("camera"), dict):
        for entry in fields(CameraSetup):
            if entry.default is not None and entry.name not in context["camera"] and entry.name != "distortion":
                sources[f"camera.{entry.name}"] = "default"
    return Inherited(context, dict(sorted(sources.items())))


def _fitting_camera(camera: Object, stated: Any) -> Object:
    """A profile's camera without the members that the upload's camera invalidates."""
    if not isinstance(stated, Mapping):
        return camera
    given = {name for name, value in stated.items() if value is not None}
    if "horizontal_fov_deg" in given:
        return {name: value for name, value in camera.items() if name not in (*_OF_THE_SIZE, *_SIZE)}
    if given & set(INTRINSICS):
        camera = {name: value for name, value in camera.items() if name != "horizontal_fov_deg"}
    if set(INTRINSICS) <= given:
        return {name: value for name, value in camera.items() if name not in (*_OF_THE_SIZE, *_SIZE)}
    for name in _SIZE:
        if name in given and camera.get(INTRINSICS[0]) is not None and stated[name] != camera.get(name):
            raise InvalidParameter(
                f"the vehicle's camera was calibrated at {camera.get('width_px')} x {camera.get('height_px')} px, "
                f"the upload states {name} {stated[name]}",
                field=f"camera.{name}",
                limit="intrinsics belong to one size of frame",
                cure="send all four intrinsics of this size, or frames of the calibrated size",
            )
    return camera


def _merge(
    ours: Mapping[str, Any], stated_members: Mapping[str, Any], sources: dict[str, str], path: str = ""
) -> Object:
    merged: Object = {}
    for name in [*ours, *(name for name in stated_members if name not in ours)]:
        at = f"{path}{name}"
        theirs, own = stated_members.get(name), ours.get(name)
        if name in stated_members and theirs is None:
            continue  # stated to be unknown
        if isinstance(theirs if name in stated_members else own, Mapping) and at not in _WHOLE:
            merged[name] = _merge(
                own if isinstance(own, Mapping) else {},
                theirs if isinstance(theirs, Mapping) else {},
                sources,
                f"{at}.",
            )
            continue
        value = theirs if name in stated_members else own
        merged[name] = {k: v for k, v in value.items() if v is not None} if isinstance(value, Mapping) else value
        sources[at] = "upload" if name in stated_members else "vehicle"
    return merged
