"""Builds the files of the image as docker/Dockerfile does, without Docker and without a network.

Folders stand for the roots of the stages, and the RUN lines are executed with their paths below them. Only one kind of
line is replaced: the requirements that pip would download are taken from the environment of the tests, which has the
same versions, and nothing else from there is taken.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from fnmatch import fnmatchcase
from importlib.metadata import distribution
from pathlib import Path

from packaging.markers import default_environment
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
NOT_IN_A_CLONE = {".git", ".venv", "var", "demo-out", "bench-out", "build", "dist", ".hypothesis"}
_PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"


def instructions(stage: str) -> list[tuple[str, str]]:
    """Instructions of a stage of docker/Dockerfile: its name, or "" for the last one."""
    text = re.sub(r"^#.*\n", "", (ROOT / "docker/Dockerfile").read_text(), flags=re.MULTILINE).replace("\\\n", " ")
    for part in re.split(r"^FROM ", text, flags=re.MULTILINE)[1:]:
        head, *lines = part.splitlines()
        if head.partition(" AS ")[2] == stage:
            return [(line.split(" ", 1)[0], line.split(" ", 1)[1].strip()) for line in lines if line.strip()]
    raise LookupError(f"docker/Dockerfile has no stage {stage!r}")


def ignore_rules() -> list[tuple[bool, list[str]]]:
    """Patterns of `.dockerignore` in order: whether one excludes, and its path in parts."""
    lines = (line.strip() for line in (ROOT / ".dockerignore").read_text().splitlines())
    return [
        (not line.startswith("!"), line.removeprefix("!").strip("/").split("/")) for line in lines if line[:1] != "#"
    ]


def matches(pattern: list[str], path: tuple[str, ...]) -> bool:
    """Whether a pattern is the path; `**` stands for any number of folders."""
    if not pattern:
        return not path
    if pattern[0] == "**":
        return any(matches(pattern[1:], path[k:]) for k in range(len(path) + 1))
    return bool(path) and fnmatchcase(path[0], pattern[0]) and matches(pattern[1:], path[1:])


def is_in_context(path: Path) -> bool:
    """Docker's rule: the last pattern that matches the path or a folder above it decides."""
    parts, included = path.parts, True
    for excludes, pattern in ignore_rules():
        if any(matches(pattern, parts[:k]) for k in range(1, len(parts) + 1)):
            included = not excludes
    return included


def context_files() -> list[Path]:
    """Files that `docker build` sends, relative to the root."""
    found = []
    for folder, folders, names in os.walk(ROOT):
        here = Path(folder).relative_to(ROOT)
        folders[:] = [name for name in folders if here != Path() or name not in NOT_IN_A_CLONE]
        found += [here / name for name in names if is_in_context(here / name)]
    return found


def below(root: Path, text: str) -> str:
    """A command or a file with the image's absolute paths below a folder."""
    return re.sub(r"(?<![\w.])(?=/(?:opt|tmp|var)/)", str(root), text).replace("python3.11", _PYTHON)


def build_image(folder: Path) -> Path:
    """Build the stages of the server's files below a folder; returns the root of the image."""
    roots = {"wheel": folder / "wheel", "build": folder / "image"}
    for stage, root in roots.items():
        (root / "opt").mkdir(parents=True)
        (root / "tmp").mkdir()
        for name, argument in instructions(stage):
            if name == "RUN":
                _run(root, argument)
            else:
                assert name == "COPY", f"{name} in a stage that is built"
                _copy(root, argument, roots)
    image = roots["build"]
    for path in (image / "opt").rglob("*"):
        if path.is_file() and not path.is_symlink():  # as in a layer of the image, whose times are whole seconds
            os.utime(path, (int(path.stat().st_mtime), int(path.stat().st_mtime)))
    for left in (image / "tmp").iterdir():  # the last stage copies /opt/waymark alone
        (shutil.rmtree if left.is_dir() else os.unlink)(left)
    (image / "var/lib/waymark").mkdir(parents=True)
    return image


def settings_of(image: Path) -> dict[str, str]:
    """The environment that the image gives its command."""
    lines = [argument for name, argument in instructions("") if name == "ENV"]
    pairs = [word.split("=", 1) for line in lines for word in line.split()]
    return {name: below(image, value).replace("$PATH", os.environ["PATH"]) for name, value in pairs}


def command_of(image: Path) -> list[str]:
    """The image's own command, with the path of its program."""
    ((_, text),) = [one for one in instructions("") if one[0] == "CMD"]
    program, *arguments = json.loads(text)
    return [str(image / "opt/waymark/bin" / program), *arguments]


def _copy(root: Path, argument: str, roots: dict[str, Path]) -> None:
    *sources, target = argument.split()
    inside = root / target.lstrip("/")
    if sources[0].startswith("--from="):
        shutil.copytree(roots[sources[0].removeprefix("--from=")] / sources[1].lstrip("/"), inside)
        return
    context = context_files()
    for source in sources:
        files = [path for path in context if path == Path(source) or Path(source) in path.parents]
        assert files, f"COPY {source}: .dockerignore excludes it"
        for path in files:
            rest = Path(path.name) if target.endswith("/") else path.relative_to(source)
            (inside / rest).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / path, inside / rest)
            if (inside / rest).read_bytes().startswith(b"#!/opt/"):
                (inside / rest).write_text(below(root, (ROOT / path).read_text()))


def _run(root: Path, command: str) -> None:
    if locked := re.fullmatch(r"(\S+)/bin/pip install .*--require-hashes -r (\S+)", command):
        _take_requirements(root / locked[1].lstrip("/"), root / locked[2].lstrip("/"))
        return
    base = {"PATH": f"{Path(sys._base_executable).parent}:{os.environ['PATH']}"}  # type: ignore[attr-defined]
    own = {name: value for name, value in os.environ.items() if not name.startswith(("WAYMARK_", "NUMBA_", "PYTHON"))}
    line = re.sub(r"^python ", f"{_PYTHON} ", below(root, command))
    done = subprocess.run(["sh", "-ec", line], env=own | base, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"RUN {command}\n{done.stdout}{done.stderr}"


def _take_requirements(environment: Path, requirements: Path) -> None:
    """Link the packages that a locked list names into a virtual environment, from that of the tests."""
    here = default_environment() | {"extra": ""}
    target = environment / "lib" / _PYTHON / "site-packages"
    for line in re.findall(r"^([\w.-]+==[^\\\n]+)", requirements.read_text(), re.MULTILINE):
        wanted = Requirement(line)
        if wanted.marker is not None and not wanted.marker.evaluate(here):
            continue
        found = distribution(wanted.name)
        assert wanted.specifier.contains(found.version), f"{line}, but {found.version} is installed"
        for old in target.glob(f"{wanted.name.replace('-', '_')}-*.dist-info"):
            shutil.rmtree(old)
        for top in {file.parts[0] for file in found.files or ()} - {"..", "__pycache__"}:
            if (target / top).is_dir() and not (target / top).is_symlink():
                shutil.rmtree(target / top)
            if not (target / top).exists():
                (target / top).symlink_to(Path(str(found.locate_file(top))))
