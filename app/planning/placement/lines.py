"""Places of line magnets along painted lines; a line between two lanes is placed once."""

from __future__ import annotations

from app.formats.alignments.geometry import BoundaryStyle
from app.markers.cerpm import LaneSide
from app.planning.alignment import Lane
from app.planning.placement.boundaries import Boundaries
from app.planning.placement.site import Site
from app.planning.plan import Purpose
from app.planning.rules import LineRules


def place_line_magnets(lane: Lane, rules: LineRules, painted: Boundaries) -> list[Site]:
    """Magnets of a lane's painted lines that no lane before it has, at even distances along each line.

    A line of unknown style counts as solid; `check_plan` says so.
    """
    sites = []
    for side, style in ((LaneSide.LEFT, lane.left_style), (LaneSide.RIGHT, lane.right_style)):
        polarity = rules.dashed if style is BoundaryStyle.DASHED else rules.solid
        if rules.sides not in ("both", side.name.lower()) or style is BoundaryStyle.NONE or polarity is None:
            continue
        for stretch in painted.add(lane, side, rules.offset_m):
            if stretch.length_m < rules.max_spacing_m / 2:
                continue
            chainages = stretch.chainages_m(rules.max_spacing_m)
            offsets = lane.value_at(stretch.offset_m, chainages)
            sites += [
                Site(chainage, offset, Purpose.PAINTED_LINE, side=side, style=style)
                for chainage, offset in zip(chainages.tolist(), offsets.tolist(), strict=True)
            ]
    return sites
