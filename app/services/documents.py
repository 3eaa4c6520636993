"""Documents made from values whose attributes have the same names."""

from __future__ import annotations

from typing import TypeVar, cast

DocumentT = TypeVar("DocumentT")


def document_of(document: type[DocumentT], source: object, **others: object) -> DocumentT:
    """A document with the attributes of a value that its members are named after, and with other members.

    Parameters
    ----------
    document : type
        A TypedDict.
    source : object
        A row or another value; it has an attribute for each member that is not in `others`.
    **others
        Members that differ from the source's, or that it does not have.
    """
    names = document.__annotations__
    return cast(DocumentT, {name: others[name] if name in others else getattr(source, name) for name in names})
