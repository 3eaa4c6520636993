"""Roads as lines on the ellipsoid: places along and beside an axis, and the measures that roads are signed with."""
