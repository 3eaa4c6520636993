"""What a test needs that a machine with Python and make may lack: a program, a server, an optional package.

Without it the test is skipped with the reason; on CI (``CI=true``), where everything is installed, it fails.
"""

from __future__ import annotations

import importlib
import os
import shutil
from types import ModuleType
from typing import NoReturn

import pytest

_PACKAGES = {
    "gs": "ghostscript",
    "nginx": "nginx-light",
    "node": "nodejs",
    "ogrinfo": "gdal-bin",
    "pdftoppm": "poppler-utils",
    "pdftotext": "poppler-utils",
}
"""Debian's packages of programs that have other names."""


def refuse(reason: str) -> NoReturn:
    """Skip the test for a reason; on CI fail."""
    __tracebackhide__ = True
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason, allow_module_level=True)


def require_tool(*names: str) -> str:
    """Path of the first of these programs that is installed."""
    __tracebackhide__ = True
    for name in names:
        if path := shutil.which(name):
            return path
    package = _PACKAGES.get(names[0])
    refuse(f"{' or '.join(names)} is not installed{f'; Debian has it in {package}' if package else ''}")


def require_module(name: str, source: str) -> ModuleType:
    """A module, e.g. of an extra; `source` says what installs it, e.g. "the extra bags"."""
    __tracebackhide__ = True
    try:
        return importlib.import_module(name)
    except (ImportError, OSError) as error:  # OSError: a library that the module binds is missing
        refuse(f"{name} needs {source}: {str(error).splitlines()[0]}")
