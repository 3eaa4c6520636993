"""Codes of a plan's markers: unused registry numbers, and tags of one codebook."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np

from app.encoders.magnet.codebook import CodebookFull, CodebookRules, allocate_codes
from app.errors import InvalidParameter
from app.markers.magnet import InformationTag
from app.markers.magnet_codebook import Codebook, Meaning
from app.markers.magnet_design import TagDesign
from app.markers.plate import PlateCode, PlateScheme
from app.planning.rules import PlateRules, TagRules

NumberSource = Callable[[int], Sequence[int]]
"""Returns as many unused registry numbers as are asked for, each only once."""
_NUMBERS = 2**32  # source: four bytes of a CERPM's message and eight data symbols of an id plate


def unused_numbers(taken: Collection[int], seed: int) -> NumberSource:
    """A source of registry numbers from 1 to 2^32 - 1 that are not taken; the same seed gives the same numbers."""
    used = set(taken)
    rng = np.random.default_rng(seed)

    def draw(count: int) -> list[int]:
        numbers: list[int] = []
        while len(numbers) < count:
            for number in rng.integers(1, _NUMBERS, count - len(numbers)).tolist():
                if number not in used:
                    used.add(number)
                    numbers.append(number)
        return numbers

    return draw


def plate_codes(
    rules: PlateRules, lon_deg: Sequence[float], lat_deg: Sequence[float], numbers: NumberSource
) -> list[PlateCode]:
    """Codes of plates at positions: their decimals, or registry numbers."""
    if rules.scheme is PlateScheme.ID:
        return [PlateCode.from_registry_number(number, n=rules.n) for number in numbers(len(lon_deg))]
    return [
        PlateCode.from_position(lon, lat, n=rules.n, scheme=rules.scheme)
        for lon, lat in zip(lon_deg, lat_deg, strict=True)
    ]


def tag_codes(
    rules: TagRules, meanings: Sequence[Meaning], book: Codebook | None, name: str
) -> tuple[Codebook, dict[Meaning, InformationTag]]:
    """A codebook with all meanings, and the tag of each; codes that the book has stay as they are.

    Raises
    ------
    InvalidParameter
        The codebook has another design than the rules, or the design has fewer codes than meanings.
    """
    design = TagDesign(rules.magnets, rules.length_m, rules.segment_m)
    if book is None:
        book = Codebook(name, design)
    elif book.design != design:
        raise InvalidParameter(
            f"the codebook {book.name!r} has tags of {book.design.magnets} magnets on {book.design.length_m:g} m",
            field="tags",
            limit=f"{design.magnets} magnets, {design.length_m:g} m, segments of {design.segment_m:g} m",
            cure="use the design of the codebook in the rules, or another codebook",
        )
    known = {meaning for _tag, meaning in book.entries}
    new = [meaning for meaning in dict.fromkeys(meanings) if meaning not in known]
    try:
        book = allocate_codes(book, new, CodebookRules())
    except CodebookFull as error:
        raise InvalidParameter(
            f"the tags of the plan have {len(known | set(meanings))} meanings: {error.message}",
            field="tags.magnets",
            limit=error.limit,
            cure="use more magnets or a longer tag, or announce fewer kinds of events",
        ) from error
    return book, {meaning: tag for tag, meaning in book.entries}
