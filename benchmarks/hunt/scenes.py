"""Scenes as numbers: what may vary, how far, and what came of one scene."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Protocol

import numpy as np

Parameters = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Bound:
    """How far a parameter of a scene may go."""

    low: float
    high: float
    simple: float  # its value in the simplest scene
    source: str  # of the bounds
    # `logarithmic`, `whole`: drawn evenly as a logarithm; drawn as a whole number
    logarithmic: bool = False
    whole: bool = False
    plain: float = 0.0  # share of scenes in which it has its simple value

    def draw(self, rng: np.random.Generator) -> float:
        """A value within the bounds."""
        share, plain = float(rng.random()), float(rng.random()) < self.plain
        if plain:
            return self.simple
        if self.whole:
            return float(math.floor(self.low + share * (self.high - self.low + 1 - 1e-9)))
        return self.at(share)

    def at(self, share: float) -> float:
        """The value at a share of the way from low to high."""
        if self.logarithmic:
            return float(self.low * (self.high / self.low) ** share)
        return self.low + share * (self.high - self.low)

    def share(self, value: float) -> float:
        """Inverse of `at`; a simple value outside of the bounds lies before or after them."""
        if not self.low <= value <= self.high:
            return -0.2 if value < self.low else 1.2
        if self.logarithmic:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)


def switch(source: str, *, simple: bool = False, plain: float = 0.0) -> Bound:
    """A parameter that is 0 or 1."""
    return Bound(0, 1, float(simple), source, whole=True, plain=plain)


class Kind(StrEnum):
    """What came of a scene; the first of them is no failure."""

    RIGHT = "right"
    BEYOND = "beyond the physical limit"
    """Not read, and no method could have."""
    WRONG = "wrong"
    """A sure answer that is not true."""
    MISSED = "missed"
    """Not read although the physical limit allows it."""
    OVERCONFIDENT = "overconfident"
    """The error is far larger than the reported standard deviation."""


FAILURES = (Kind.WRONG, Kind.OVERCONFIDENT, Kind.MISSED)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of one scene."""

    kind: Kind
    badness: float = 0.0  # how bad a failure is, to find the worst: in units of the family
    detail: str = ""  # what happened, in a few words
    # reported confidence of each reading, and whether it was right
    sure: list[tuple[float, bool]] = field(default_factory=list)
    # normalised squared error of each estimate and its degrees of freedom (NEES)
    squared: list[tuple[float, int]] = field(default_factory=list)
    read: float | None = None  # share read of what the physical limit allows; None where it allows nothing


class Family(Protocol):
    """Scenes of one decoder."""

    bounds: Mapping[str, Bound]

    def evaluate(self, parameters: Parameters, seed: int) -> Outcome:
        """Simulate a scene, decode it, and judge it beside the physical limit."""

    def draw(self, parameters: Parameters, seed: int, path: Path) -> None:
        """Draw a scene as a picture."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A scene that was evaluated."""

    seed: int
    parameters: dict[str, float]
    outcome: Outcome

    @property
    def failed(self) -> bool:
        """Whether the decoder failed."""
        return self.outcome.kind in FAILURES


def draw_parameters(bounds: Mapping[str, Bound], seed: int) -> dict[str, float]:
    """The parameters of a scene; they depend on the seed alone."""
    rng = np.random.default_rng([seed, 1])
    return {name: bound.draw(rng) for name, bound in bounds.items()}


def simplest(bounds: Mapping[str, Bound]) -> dict[str, float]:
    """The parameters of the simplest scene."""
    return {name: bound.simple for name, bound in bounds.items()}


def describe(bounds: Mapping[str, Bound], parameters: Parameters) -> str:
    """The parameters that differ from the simplest scene."""
    odd = {k: v for k, v in parameters.items() if v != bounds[k].simple}
    return ", ".join(f"{k} {v:.3g}" for k, v in odd.items()) or "the simplest scene"
