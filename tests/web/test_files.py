"""The files of the web pages: their policy, their texts, their addresses, and what browsers may keep of them."""

from __future__ import annotations

import json
import re
import socket
from contextlib import ExitStack, suppress
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from app.api.http.ui import PAGES, import_map_hashes
from app.settings import Settings
from tests.conftest import LiveServer

ROOT = Path(__file__).resolve().parents[2]
STATIC = ROOT / "static"
APP = STATIC / "app"
OURS = [*STATIC.glob("*.*"), *APP.rglob("*.js"), *APP.rglob("*.css")]


def _texts(language: str) -> dict[str, str]:
    lines = re.findall(r'^  ("[^"]+"): (".*"),$', (APP / f"texts/{language}.js").read_text(), re.M)
    found = {json.loads(name): json.loads(text) for name, text in lines}
    assert len(found) == len(lines) > 300, "a name stands twice, or a line has another form"
    return found


def test_both_languages_have_the_same_texts() -> None:
    english, german = _texts("en"), _texts("de")
    assert english.keys() == german.keys()
    for name, text in english.items():
        assert set(re.findall(r"\{\w+\}", text)) == set(re.findall(r"\{\w+\}", german[name])), name
    assert sum(english[name] != german[name] for name in english) > len(english) * 0.8


def test_every_text_is_used_and_no_other_is() -> None:
    code = "\n".join(path.read_text() for path in APP.rglob("*.js") if path.parent.name != "texts")
    names = _texts("en").keys()
    assert {name for name in re.findall(r'\bt\("([^"]+)"', code) if name not in names} == set()
    prefixes = tuple(re.findall(r"[`\"]([a-z_]+\.(?:[a-z]+_)?)\$\{", code))
    assert len(prefixes) > 10
    assert {name for name in names if f'"{name}"' not in code and not name.startswith(prefixes)} == set()


def test_words_of_the_pages_are_texts() -> None:
    """What people read stands in texts/: between tags there are only expressions, signs and names of units."""
    found = []
    for path in [*APP.glob("pages/*.js"), *APP.glob("components/*.js")]:
        for template in re.findall(r"html`(.*?)`", path.read_text(), re.S):
            plain = re.sub(r"\$\{[^{}]*\}", "", template)
            found += [
                f"{path.name}: {text.strip()}"
                for text in re.findall(r">([^<>$`{}]*)<", plain)
                if re.search(r"[a-z]{4,}", text) and text.strip() not in ("Waymark",)
            ]
    assert [text for text in found if "=>" not in text and "POST /v1" not in text] == []


def test_the_server_answers_the_addresses_that_the_pages_have() -> None:
    patterns = re.findall(r'pattern: "([^"]+)"', (APP / "routes.js").read_text())
    ours = {re.sub(r":\w+", "{}", pattern) for pattern in patterns}
    served = {re.sub(r"\{\w+\}", "{}", page) for page in PAGES}
    sections = {"/operations/vehicles", "/operations/vehicles/{}"}  # inside of /operations/{section}
    assert ours - sections == served


def test_the_policy_allows_our_own_files_only(server: LiveServer) -> None:
    with server.client(None) as client:
        for path in ("/", "/markers", "/markers/some-id", "/operations/jobs", "/docs", "/redoc", "/static/app/main.js"):
            answer = client.get(path)
            assert answer.status_code == 200, path
            policy = dict(part.split(" ", 1) for part in answer.headers["content-security-policy"].split("; "))
            assert policy["default-src"] == "'none'"
            assert policy["connect-src"] == policy["worker-src"] == policy["form-action"] == "'self'"
            assert policy["img-src"] == "'self' blob:"
            assert "unsafe" not in str(policy)
            assert policy["script-src"].split()[0] == "'self'"
        assert (
            import_map_hashes((STATIC / "index.html").read_text())[0]
            in client.get("/").headers["content-security-policy"]
        )
        for outside in ("/static/../pyproject.toml", "/static/none.js", "/markers/a/b", "/nowhere"):
            assert client.get(outside).status_code == 404
        for below in ("/v1/nowhere", "/ogc/nowhere"):
            assert client.get(below).headers["content-type"] == "application/problem+json"


def test_our_files_have_no_inline_code_and_name_no_other_host() -> None:
    assert len(OURS) > 40
    for file in OURS:
        text = file.read_text()
        assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", text), file.name
        assert not re.search(
            r"<script(?![^>]*(src=|importmap))|\son[a-z]+=\"|\sstyle=[\"$]|innerHTML|outerHTML|insertAdjacentHTML|"
            r"dangerouslySetInnerHTML|\beval\(|new Function",
            text,
        ), file.name


def test_imports_have_an_address(server: LiveServer) -> None:
    (text,) = re.findall(r'<script type="importmap">(.*?)</script>', (STATIC / "index.html").read_text(), re.S)
    imports = json.loads(text)["imports"]
    wanted = {
        name
        for path in APP.rglob("*.js")
        for name in re.findall(
            r'\b(?:from |import\(|import\.meta\.resolve\()"([^".][^"]*)"',
            re.sub(r"/\*.*?\*/", "", path.read_text(), flags=re.S),
        )
    }
    assert len(wanted) > 6
    assert wanted <= imports.keys()
    with server.client(None) as client:
        for address in imports.values():
            assert client.get(address).status_code == 200, address


@pytest.mark.parametrize(("accepted", "encoding"), [("gzip, br", "br"), ("gzip", "gzip"), ("identity", None)])
def test_vendored_files_are_compressed_and_kept(server: LiveServer, accepted: str, encoding: str | None) -> None:
    (path,) = STATIC.glob("vendor/maplibre-gl-*/maplibre-gl.js")
    address = f"/{path.relative_to(ROOT)}"
    with server.client(None) as client:
        answer = client.get(address, headers={"Accept-Encoding": accepted})
        assert answer.headers.get("content-encoding") == encoding
        assert "accept-encoding" in answer.headers["vary"].lower()
        assert answer.headers["cache-control"] == "public, max-age=31536000, immutable"
        assert answer.headers["content-type"].startswith("text/javascript")
        if encoding != "br":  # httpx decodes it only with a package that we do not need otherwise
            assert answer.content == path.read_bytes()
        again = client.get(address, headers={"Accept-Encoding": accepted, "If-None-Match": answer.headers["etag"]})
        assert again.status_code == 304
        ours = client.get("/static/app/main.js", headers={"Accept-Encoding": accepted})
        assert ours.headers["cache-control"] == "no-cache"
        assert ours.headers.get("content-encoding") == ("gzip" if "gzip" in accepted else None)
        assert ours.content == (APP / "main.js").read_bytes()
        assert client.get("/static/app/main.js", headers={"If-None-Match": ours.headers["etag"]}).status_code in (
            200,
            304,
        )


def test_readers_that_do_not_read_hold_no_file_open(server: LiveServer) -> None:
    """The file is larger than what the buffers of a connection hold."""
    path = STATIC / "vendor/redoc-2.5.1/redoc.standalone.js"
    request = f"GET /{path.relative_to(ROOT)} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
    address = urlsplit(server.url)
    with ExitStack() as held:
        for _ in range(3):
            reader = held.enter_context(socket.socket())
            reader.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            reader.connect((address.hostname, address.port))
            reader.sendall(request)
            assert reader.recv(1, socket.MSG_PEEK) == b"H"
        assert [name for name in _open_files() if name.startswith(str(STATIC))] == []


def _open_files() -> list[str]:
    found = []
    for link in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # closed since it was listed
            found.append(str(link.readlink()))
    return found


def test_vendored_programs_have_licences_and_nothing_of_other_hosts() -> None:
    folders = [folder for folder in (STATIC / "vendor").iterdir() if folder.is_dir() and folder.name != "licences"]
    assert len(folders) > 10
    for folder in folders:
        assert re.search(r"-\d+\.\d+\.\d+$", folder.name)
        assert len((folder / "LICENSE").read_text()) > 300
        for style in folder.glob("*.css"):
            assert 'url("data:' not in style.read_text()
            assert "url(http" not in style.read_text()
    lock = (ROOT / "package-lock.json").read_text()
    assert '"resolved"' not in lock
    assert "registry" not in lock
    versions = {name: entry["version"] for name, entry in json.loads(lock)["packages"].items() if name}
    for folder in folders:
        name, _, version = folder.name.rpartition("-")
        known = {"signals": "@preact/signals", "signals-core": "@preact/signals-core", "swagger-ui": "swagger-ui-dist"}
        assert versions[f"node_modules/{known.get(name, name)}"] == version


def test_a_configured_base_map_is_announced_and_allowed(settings: Settings, serve, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    file = tmp_path / "town.pmtiles"
    file.write_bytes(bytes(range(256)) * 8)
    with_file = serve(settings.model_copy(update={"base_map": str(file), "base_map_attribution": "<b>Town</b>"}))
    with with_file.client(None) as client:
        announced = client.get("/v1/page-settings").json()["base_map"]
        assert announced == {"kind": "pmtiles", "url": "/static/base-map.pmtiles", "attribution": "<b>Town</b>"}
        part = client.get(announced["url"], headers={"Range": "bytes=2-5"})
        assert (part.status_code, part.content) == (206, bytes([2, 3, 4, 5]))


def test_configured_hosts_are_in_the_policy(settings: Settings, serve) -> None:  # type: ignore[no-untyped-def]
    changes = {
        "base_map": "https://tiles.example.org/{z}/{x}/{y}.png",
        "oidc_client_id": "pages", "oidc_issuer": "https://id.example.org", "oidc_audience": "waymark",
        "oidc_jwks": "https://id.example.org/jwks", "oidc_authorize_url": "https://id.example.org/authorize",
        "oidc_token_url": "https://id.example.org/token",
    }  # fmt: skip
    running = serve(settings.model_copy(update=changes))
    with running.client(None) as client:
        policy = client.get("/").headers["content-security-policy"]
        assert "connect-src 'self' https://id.example.org https://tiles.example.org;" in policy
        announced = client.get("/v1/page-settings").json()["sign_in"]
        assert announced["client_id"] == "pages"
        assert announced["authorize_url"] == "https://id.example.org/authorize"


@pytest.mark.parametrize(
    "changes",
    [
        {"base_map": "nowhere.pmtiles"},
        {"base_map": "https://tiles.example.org/{z}/{x}.png"},
        {"base_map": "https://a.example.org;script-src *;/{z}/{x}/{y}"},
        {"oidc_client_id": "pages"},
    ],
)
def test_settings_that_cannot_work_are_refused(changes: dict[str, str]) -> None:
    with pytest.raises(ValueError, match=r"base_map|PMTiles|oidc_"):
        Settings(**changes)  # type: ignore[arg-type]


def test_me_says_who_calls_and_what_they_may(server: LiveServer) -> None:
    with server.client() as client:
        mine = client.get("/v1/me").json()
        assert (mine["agency"], mine["scope"]) == ("default", "admin")
        assert "DELETE /v1/keys/{key_id}" in mine["permissions"]
        assert "GET /" not in mine["permissions"]
    from app.services.access.access import Scope

    with server.agency("Readers", Scope.VIEWER) as viewer:
        theirs = viewer.get("/v1/me").json()
        assert theirs["agency"] == "Readers"
        assert "PATCH /v1/markers/{marker_id}" not in theirs["permissions"]
        assert "GET /v1/markers" in theirs["permissions"]
    with server.client(None) as nobody:
        assert nobody.get("/v1/me").status_code == 401
