"""What a machine lacks is asked for in one place: a reason to skip, and on CI to fail."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from tests import machine

TESTS = Path(__file__).parent


@pytest.mark.parametrize(("ci", "outcome"), [("", pytest.skip.Exception), ("true", pytest.fail.Exception)])
def test_what_is_missing_skips_a_test_and_fails_it_on_ci(
    ci: str, outcome: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CI", ci)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(outcome, match="pdftotext is not installed; Debian has it in poppler-utils"):
        machine.require_tool("pdftotext")
    with pytest.raises(outcome, match="not_a_module needs the extra none: No module named"):
        machine.require_module("not_a_module", "the extra none")


def test_what_is_there_is_returned() -> None:
    assert machine.require_tool("not-a-program", sys.executable) == sys.executable
    assert machine.require_module("json", "Python") is sys.modules["json"]


def test_a_library_that_a_module_binds_may_be_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As cairosvg without libcairo."""
    (tmp_path / "binds_a_library.py").write_text("import ctypes\nctypes.CDLL('libnone.so.2')\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delenv("CI", raising=False)
    with pytest.raises(pytest.skip.Exception, match=r"binds_a_library needs libnone: libnone\.so\.2"):
        machine.require_module("binds_a_library", "libnone")


def test_no_test_looks_for_programs_and_packages_itself() -> None:
    """But for `setpriv` and `unshare`, without which a test runs with fewer limits."""
    own = re.compile(
        r'shutil\.which\((?!"(?:setpriv|unshare)")|importorskip\(|environ(\.get\(|\[)"CI"|^import cairosvg'
        r'|\["(pdfto|ogrinfo|gs")',
        re.M,
    )
    files = [path for path in TESTS.rglob("*.py") if path.name not in ("machine.py", Path(__file__).name)]
    assert len(files) > 300
    found = {path.relative_to(TESTS).as_posix(): own.findall(path.read_text()) for path in files}
    assert {name for name, places in found.items() if places} == set()
