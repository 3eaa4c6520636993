"""Small OpenDRIVE files for tests."""

from __future__ import annotations

LINE = '<geometry s="0" x="0" y="0" hdg="0" length="{0}"><line/></geometry>'
LANE = '<lane id="{0}" type="driving">{1}<width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>'
LEFT, RIGHT = LANE.format(1, ""), LANE.format(-1, "")


def section(s: float = 0.0, left: str = LEFT, right: str = RIGHT, centre: str = "") -> str:
    """A lane section."""
    lane_0 = f'<center><lane id="0" type="none">{centre}</lane></center>'
    return f'<laneSection s="{s}"><left>{left}</left>{lane_0}<right>{right}</right></laneSection>'


def road(
    plan: str | None = None,
    *,
    lanes: str | None = None,
    extra: str = "",
    attributes: str = 'id="7" junction="-1"',
    length: float = 100.0,
) -> str:
    """A road, straight from 0, 0 to the east without a plan."""
    shape = LINE.format(length) if plan is None else plan
    return (
        f'<road length="{length}" {attributes}><planView>{shape}</planView>{extra}'
        f"<lanes>{section() if lanes is None else lanes}</lanes></road>"
    )


def document(*roads: str, header: str = "") -> bytes:
    """A file of roads."""
    head = f'<header revMajor="1" revMinor="7">{header}</header>'
    return f'<?xml version="1.0"?><OpenDRIVE>{head}{"".join(roads or (road(),))}</OpenDRIVE>'.encode()
