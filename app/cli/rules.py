"""Commands for the rules of plans."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

_HELP = "The rules of plans: their JSON Schema, and a check of a document."
cli = typer.Typer(no_args_is_help=True, help=_HELP)


@cli.callback(help=_HELP)
def rules() -> None:
    """Group the commands `waymark rules ...`."""


@cli.command()
def schema() -> None:
    """Print the JSON Schema (draft 2020-12) of the rules."""
    import orjson

    from app.planning.read_rules import rules_schema

    typer.echo(orjson.dumps(rules_schema(), option=orjson.OPT_INDENT_2))


@cli.command()
def check(
    file: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="Rules as YAML or JSON.")],
) -> None:
    """Read rules and print them with their defaults as JSON. The exit status is 2 if they are refused."""
    from app.cli.errors import bad_input
    from app.planning.read_rules import read_rules

    with bad_input():
        read = read_rules(file.read_bytes())
    typer.echo(read.model_dump_json(indent=2, by_alias=True))
