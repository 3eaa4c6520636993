"""The command that decodes a magnetometer trace without a server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.cli.declarations import read_declaration


def decode_trace(
    recording: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="A file, or a ZIP of one recording.")],
    declared: Annotated[str, typer.Option("--declaration", help="Declaration as JSON; see docs/magnets.md.")] = "{}",
    plot: Annotated[Path | None, typer.Option(help="SVG file for the plot.")] = None,
) -> None:
    """Decode the magnets and tags in a magnetometer trace, and print one JSON object."""
    import orjson

    from app.api.decodes.schemas_traces import TraceIn
    from app.decoders.magnet.match import match_tags
    from app.formats.spooled_file import SpooledFile
    from app.jobs.trace_tasks import decode_recording
    from app.services.decodes.trace_documents import trace_document
    from app.services.decodes.trace_task import TraceTask, trace_terms

    terms = read_declaration(TraceIn, declared, "docs/magnets.md").model_dump(exclude_unset=True)
    result = decode_recording(TraceTask(recording.name, SpooledFile.at(recording), terms), None)
    trace = match_tags(result.findings, (), trace_terms(terms).bar)
    if plot is not None:
        plot.write_bytes(result.plot)
    document = trace_document(result, trace, codebook_tags=0)
    typer.echo(orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY))
