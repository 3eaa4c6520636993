"""What a format of uploaded files is: a name, a way to detect it and a way to read it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from functools import cached_property
from typing import Generic, TypeVar

from app.formats.delimited import DelimitedLog
from app.formats.text import decode_text, is_clean_text, is_text

ReadT_co = TypeVar("ReadT_co", covariant=True)


class Use(StrEnum):
    """What the files of a format are used for."""

    FRAME = "frame"
    TRACE = "trace"
    PACKETS = "packets"
    POSES = "poses"
    SURVEY = "survey"
    ALIGNMENT = "alignment"


class Confidence(IntEnum):
    """How sure it is that a file has a format.

    `POSSIBLE` is enough where the use is declared (any text can be CSV), `PLAUSIBLE` where it has to be guessed. Known
    column names make a format `LIKELY`, a signature makes it `CERTAIN`.
    """

    NONE = 0
    POSSIBLE = 1
    PLAUSIBLE = 2
    LIKELY = 3
    CERTAIN = 4


@dataclass(frozen=True)
class Sample:
    """What detection looks at.

    Attributes
    ----------
    name : str
        Of the file; its suffix is a hint.
    data : bytes
        The file, or its beginning.
    declared : mapping of str to str
        Names of columns that the uploader declares, by quantity.
    """

    name: str
    data: bytes
    declared: Mapping[str, str] = field(default_factory=dict)

    @property
    def suffix(self) -> str:
        """With its dot, in lower case."""
        return "." + self.name.rsplit(".", 1)[-1].lower()

    @cached_property
    def is_text(self) -> bool:
        """Whether it looks like text, possibly damaged."""
        return is_text(self.data)

    @cached_property
    def is_clean_text(self) -> bool:
        """Whether it looks like undamaged text in ASCII or UTF-8."""
        return is_clean_text(self.data)

    @cached_property
    def decoded(self) -> tuple[str, str | None]:
        """Its text, and a warning about the encoding or None."""
        return decode_text(self.name, self.data)

    @property
    def text(self) -> str:
        """Its text."""
        return self.decoded[0]

    @cached_property
    def start(self) -> str:
        """The first characters of the text, without blanks before them."""
        return self.text[:_START_CHARS].lstrip("\ufeff \t\r\n")

    @cached_property
    def log(self) -> DelimitedLog:
        """The text as a table with a header."""
        return DelimitedLog.open(self.text)


_START_CHARS = 1 << 16  # [character] chosen by hand


@dataclass(frozen=True, slots=True)
class Format(Generic[ReadT_co]):
    """A format of uploaded files.

    Attributes
    ----------
    name : str
        As reports and declarations have it.
    use : Use
    description : str
        For messages that list what is accepted.
    detect : callable
        How sure it is that a sample has this format.
    read : callable
        Reads a file; each use has its own parameters.
    """

    name: str
    use: Use
    description: str
    detect: Callable[[Sample], Confidence]
    read: ReadT_co


def detect_format(
    sample: Sample, formats: Iterable[Format[ReadT_co]], at_least: Confidence = Confidence.POSSIBLE
) -> Format[ReadT_co] | None:
    """The format that fits a sample best, the first of several; None if none is as likely as asked for."""
    rated = [(found.detect(sample), found) for found in formats]
    confidence, best = max(rated, key=lambda pair: pair[0])
    return best if confidence >= at_least else None


def list_accepted(formats: Iterable[Format[object]]) -> str:
    """Descriptions of formats, for a message."""
    return ", ".join(found.description for found in formats)


def detect_signature(*signatures: bytes) -> Callable[[Sample], Confidence]:
    """Detection by the first bytes."""

    def detect(sample: Sample) -> Confidence:
        return Confidence.CERTAIN if sample.data.startswith(signatures) else Confidence.NONE

    return detect
