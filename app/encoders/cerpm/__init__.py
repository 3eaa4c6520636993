"""Encoding of CERPMs: the message that a marker sends, and the table that markers are programmed from."""

from app.encoders.cerpm.explain import explain_payload, hex_dump
from app.encoders.cerpm.payload import encode_message
from app.encoders.cerpm.program import MarkerProgram, write_programs_csv

__all__ = [
    "MarkerProgram",
    "encode_message",
    "explain_payload",
    "hex_dump",
    "write_programs_csv",
]
