"""The reference of the command line, from the help of `waymark`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer
from typer.main import get_command

from app.cli import cli
from guide.markdown import code, table

_PAGE = "reference/commands"


def write_command_page(folder: Path) -> tuple[str, str, str]:
    """Write it; returns its name, title and text for the index."""
    path = folder / f"{_PAGE}.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    parts = [
        "# The command `waymark`\n\n"
        "This page is made from the program's own help: `waymark COMMAND --help` prints the same text. Settings are "
        "environment variables ([settings](../settings.md)). For an expected error, a command prints the error, its "
        "limit and its cure to standard error, and ends with exit status 1; for invalid arguments, with 2.\n\n"
    ]
    parts += (_section(name, command) for name, command in list_commands())
    path.write_text("".join(parts))
    return _PAGE, "Command line", "every command with its arguments and options, from its help"


def list_commands() -> Iterator[tuple[str, Any]]:
    """All commands with their full names, groups before their members."""
    yield from _below("waymark", get_command(cli))


def _below(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    yield name, command
    for part, member in getattr(command, "commands", {}).items():
        yield from _below(f"{name} {part}", member)


def _section(name: str, command: Any) -> str:
    context = typer.Context(command, info_name=name)
    usage = " ".join([name, *command.collect_usage_pieces(context)])
    arguments, options = [], []
    for parameter in command.params:
        if getattr(parameter, "hidden", False):
            continue
        (arguments if parameter.param_type_name == "argument" else options).append(_row(parameter, context))
    text = f"## {code(name)}\n\n{(command.help or '').strip()}\n\n```text\n{usage}\n```\n\n"
    text += table(("argument", "required", "meaning"), arguments)
    return text + table(("option", "value", "default", "meaning"), options)


def _row(parameter: Any, context: typer.Context) -> tuple[str, ...]:
    help_text = getattr(parameter, "help", None) or ""
    if parameter.param_type_name == "argument":
        return code(parameter.make_metavar(context)), "yes" if parameter.required else "", help_text
    names = ", ".join(code(name) for name in (*parameter.opts, *parameter.secondary_opts))
    value = "" if parameter.is_flag else code(parameter.make_metavar(context))
    return names, value, "required" if parameter.required else _default_text(parameter), help_text


def _default_text(parameter: Any) -> str:
    default = parameter.default
    if callable(default) or default is None or default in ((), [], "", False) or "Sentinel" in type(default).__name__:
        return ""
    if isinstance(default, (list, tuple)):
        return ", ".join(code(value) for value in default)
    return code(getattr(default, "value", default))
