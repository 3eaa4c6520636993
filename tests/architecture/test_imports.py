"""The rules of docs/architecture.md hold: imports point one way, the core is pure, nothing happens at import."""

from __future__ import annotations

import ast
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import app
from app.jobs.forkserver_preload import DECODERS, TASKS

ROOT = Path(__file__).resolve().parents[2]
CORE = (
    "planning", "surveys", "simulation", "encoders", "decoders", "lanes", "formats", "radio", "calibration", "markers",
    "sensors", "roads", "geodesy", "errors", "tracks", "health",
)  # fmt: skip
MAX_LINES = 750
MAX_FILES = 500


def _modules(prefix: str = "app") -> list[str]:
    return [module.name for module in pkgutil.walk_packages(app.__path__, "app.") if module.name.startswith(prefix)]


def test_the_import_contracts_are_kept() -> None:
    lint = Path(sys.executable).with_name("lint-imports")
    run = subprocess.run([lint, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "0 broken" in run.stdout


@pytest.mark.slow
def test_the_core_imports_no_framework_no_database_and_nothing_heavy() -> None:
    """Libraries of GIS and CAD files and parts of SciPy are loaded when they are used: a server has 130 MB less."""
    names = [name for name in _modules() if name.split(".")[1] in CORE]
    assert len(names) > 15
    program = (
        f"import importlib, sys\nfor name in {names!r}: importlib.import_module(name)\n"
        "print(sorted({'.'.join(m.split('.')[:k]) for m in sys.modules for k in (1, 2)} "
        "& {'fastapi', 'starlette', 'sqlalchemy', 'alembic', 'pydantic_settings', 'httpx', 'uvicorn', 'structlog', "
        "'pyogrio', 'pyarrow', 'ezdxf', "
        "'scipy.stats', 'scipy.signal', 'scipy.optimize', 'scipy.spatial', 'scipy.ndimage'}))"
    )
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.slow
def test_a_server_loads_decoders_and_simulations_only_when_it_needs_one(tmp_path: Path) -> None:
    """They compile with Numba, which takes 70 MB and a second at each start; other libraries, few requests need.

    No route is built either: its dependencies are analysed when it is first requested. The first start migrates the
    database with Alembic, the second has nothing to migrate.
    """
    program = """
import sys
from app.jobs.forkserver_preload import DECODERS
from app.main import create_app
from app.settings import Settings
app = create_app(Settings(data_dir="."))
app.state.database.migrate()
late = {"numba", *DECODERS, "scipy.stats", "scipy.signal", "scipy.optimize",
    "scipy.spatial", "pyogrio", "pyarrow", "ezdxf", "reportlab", "celery", "boto3", "psycopg", "jwt", "httpx", "gpxpy",
    "pynmeagps", "av", "mcap", "rosbags", "typer", "alembic"}
print(late & set(sys.modules), [route.path for route in app.routes if "dependant" in vars(route)])
"""
    for loaded in ("{'alembic'} []", "set() []"):
        run = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True)
        assert run.stdout.strip() == loaded


def test_decoder_processes_have_what_their_tasks_import_from_their_start() -> None:
    """A module that one of them imported in a task would take its time and memory in each process."""
    rare = {"app.decoders.magnet.metro", "app.plots.track", "app.tracks.estimate", "app.tracks.files"}
    tasks = [path for path in (ROOT / "app/services").rglob("*tasks.py") if path.name != "decoder_tasks.py"]
    assert {".".join(path.relative_to(ROOT).with_suffix("").parts) for path in tasks} == set(TASKS)
    steps = [step for path in tasks for step in ast.parse(path.read_text("utf-8")).body]
    functions = [step for step in steps if isinstance(step, ast.FunctionDef | ast.ClassDef)]
    imports = [node for step in functions for node in ast.walk(step) if isinstance(node, ast.ImportFrom)]
    assert len(imports) > 10
    names = {(node.module, f"{node.module}.{alias.name}") for node in imports for alias in node.names}
    assert {module for module, name in names if not {module, name} & {*DECODERS, *rare}} == set()


@pytest.mark.slow
def test_no_module_creates_an_app_or_reads_settings_at_import(tmp_path: Path) -> None:
    program = f"""
import importlib, os, sys
sys.path.insert(0, {str(ROOT)!r})
import fastapi, pydantic_settings, sqlalchemy
def refuse(what):
    def init(self, *args, **kwargs):
        raise AssertionError(what + " at import")
    return init
fastapi.FastAPI.__init__ = refuse("an app")
pydantic_settings.BaseSettings.__init__ = refuse("settings")
sqlalchemy.create_engine = refuse("an engine")
for name in {_modules()!r}:
    importlib.import_module(name)
print(sorted(os.listdir(".")))
"""
    run = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "[]", "importing wrote files"


@pytest.mark.parametrize("name", ["requirements.txt", "requirements-dev.txt"])
def test_locked_dependencies_have_hashes_and_no_addresses(name: str) -> None:
    text = (ROOT / name).read_text()
    pins = [line for line in text.splitlines() if line[:1].isalnum()]
    assert len(pins) > 40
    assert all("==" in line and line.endswith("\\") for line in pins)
    assert "://" not in text
    assert "index-url" not in text.replace("--no-emit-index-url", "")


def test_a_module_is_a_topic() -> None:
    lengths = {path: len(path.read_text("utf-8").splitlines()) for path in (ROOT / "app").rglob("*.py")}
    assert 400 < len(lengths) <= MAX_FILES
    assert {str(path.relative_to(ROOT)): n for path, n in lengths.items() if n > MAX_LINES} == {}
