"""What kind of version a change of a marker makes: as somebody says, or by what changes."""

from __future__ import annotations

from enum import StrEnum

from app.errors import InvalidParameter

_PLANNED, _BUILT = "planned", "built"


class VersionKind(StrEnum):
    """Why a marker has a further version (docs/history.md)."""

    AS_PLANNED = "as-planned"
    AS_BUILT = "as-built"
    RESURVEY = "resurvey"
    CORRECTION = "correction"
    CHANGE = "change"


def kind_of_new(status: str, said: str | None = None) -> VersionKind:
    """Kind of a marker's first version: as planned, or as built where it is said to be on the road.

    Raises
    ------
    InvalidParameter
        It is not of the kind that was asked for.
    """
    fitting = [VersionKind.AS_PLANNED] if status == _PLANNED else [VersionKind.AS_BUILT, VersionKind.RESURVEY]
    if said is not None and said not in fitting:
        raise _refused(said, f"the first version of a marker that is {status}", *fitting)
    return VersionKind(said) if said is not None else fitting[0]


def kind_of_change(old_status: str, new_status: str, *, moved: bool, said: str | None = None) -> VersionKind:
    """Kind of a further version.

    Parameters
    ----------
    old_status, new_status : str
    moved : bool
        The change gives a position.
    said : str, optional
        Kind that was asked for.

    Raises
    ------
    InvalidParameter
        The change is not of the kind that was asked for.
    """
    if said == VersionKind.CORRECTION:
        return VersionKind.CORRECTION
    if new_status == _PLANNED:
        fitting = [VersionKind.AS_PLANNED]
    elif not moved:
        fitting = [VersionKind.CHANGE]
    elif old_status in (_PLANNED, _BUILT):
        fitting = [VersionKind.AS_BUILT, VersionKind.RESURVEY]
    else:
        fitting = [VersionKind.RESURVEY, VersionKind.AS_BUILT]
    if said is not None and said not in fitting:
        what = f"a change {'with' if moved else 'without'} a position of a marker that is then {new_status}"
        raise _refused(said, what, *fitting, VersionKind.CORRECTION)
    return VersionKind(said) if said is not None else fitting[0]


def _refused(said: str, what: str, *fitting: VersionKind) -> InvalidParameter:
    return InvalidParameter(
        f"{what} is no version of the kind {said}",
        field="kind",
        limit=" or ".join(fitting),
        cure="leave the kind out, or send the status and the position that belong to it",
    )
