"""Keys: made, shown once, mistyped, replaced with an overlap, ended, and when they were last used."""

from __future__ import annotations

import re
import string
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from app.errors import InvalidParameter, NotAuthenticated
from app.registry.agencies import api_keys
from app.registry.audit import list_entries
from app.registry.database import Database
from app.registry.tables import metadata
from app.services.access.access import Access, Caller, Scope, check_key, new_key
from app.services.access.keys import Keys, NewKey
from tests.conftest import LiveServer
from tests.http import refused

pytestmark = pytest.mark.both_databases

FORM = re.compile(r"wm_[0-9A-Za-z]{8}_[0-9A-Za-z]{43}_[0-9A-Za-z]{6}")
NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


class Clock:
    """A clock that tests set."""

    now = NOW

    def __call__(self) -> datetime:
        return self.now


@pytest.fixture
def database(tmp_path: Path, new_database_url: Callable[[Path], str]) -> Iterator[Database]:
    database = Database(new_database_url(tmp_path))
    database.open()
    database.migrate()
    yield database
    database.close()


@pytest.fixture
def admin(server: LiveServer, request: pytest.FixtureRequest) -> Iterator[httpx.Client]:
    with server.agency(f"keepers of {request.node.name}", Scope.ADMIN) as client:
        yield client


def _made(admin: httpx.Client, **wanted: Any) -> dict[str, Any]:
    response = admin.post("/v1/keys", json={"scope": "viewer", "label": "a map"} | wanted)
    assert response.status_code == 201, response.text
    return dict(response.json())


def _works(server: LiveServer, key: str) -> bool:
    with server.client(key) as client:
        return client.get("/v1/markers").status_code == 200


# --- what a key looks like ----------------------------------------------------------------------------------------


def test_keys_have_a_form_that_scanners_find() -> None:
    keys = {new_key() for _ in range(200)}
    assert len(keys) == 200
    assert len({key.split("_")[2] for key in keys}) == 200
    for key in keys:
        assert FORM.fullmatch(key)
        check_key(key)
    firsts = {key.split("_")[2][-1] for key in keys}
    assert len(firsts) > 50  # of 62: the bits are spread over all characters


def test_the_form_of_keys_is_as_documented() -> None:
    text = (Path(__file__).resolve().parents[3] / "docs" / "access.md").read_text()
    stated = re.search(r"check digits: (\d+) characters in all", text)
    assert stated is not None
    assert int(stated[1]) == len(new_key())
    (example,) = re.findall(r"^    (wm_\w+)$", text, re.MULTILINE)
    check_key(example)


def test_every_wrong_character_and_every_swap_is_noticed() -> None:
    key = new_key()
    alphabet = string.ascii_letters + string.digits
    for place, character in enumerate(key):
        others = [c for c in alphabet if c != character] if place > 2 and character != "_" else []
        for other in others:
            with pytest.raises(NotAuthenticated):
                check_key(key[:place] + other + key[place + 1 :])
    for place in range(3, len(key) - 1):
        swapped = key[:place] + key[place + 1] + key[place] + key[place + 2 :]
        if swapped != key:
            with pytest.raises(NotAuthenticated):
                check_key(swapped)
    for cut in (key[:-1], key[1:].replace("m_", "wm_", 1)[:-1], key + "0", "wm_", key.replace("_", "-")[:3] + "_"):
        if cut.startswith("wm_"):
            with pytest.raises(NotAuthenticated):
                check_key(cut)
    check_key("an-admin-key-of-another-form")


def test_a_mistyped_key_is_refused_without_a_query(database: Database) -> None:
    access = Access(database, Clock())
    key = access.create_key("agency", Scope.VIEWER, "a key")
    statements: list[str] = []
    sa.event.listen(database.engine, "before_cursor_execute", lambda *args: statements.append(args[2]))
    with pytest.raises(NotAuthenticated, match="mistyped"):
        access.authenticate(key[:-1] + ("0" if key[-1] != "0" else "1"))
    assert statements == []
    with pytest.raises(NotAuthenticated, match="unknown"):
        access.authenticate(new_key())
    assert any("FROM api_keys" in statement for statement in statements)
    assert access.authenticate(key).scope is Scope.VIEWER


@pytest.mark.slow
def test_the_environments_key_may_be_of_any_form_but_not_mistyped(database: Database) -> None:
    access = Access(database, Clock())
    key = new_key()
    with pytest.raises(InvalidParameter, match="mistyped"):
        access.ensure_first_key(key[:-1] + ("0" if key[-1] != "0" else "1"))
    assert access.ensure_first_key(key) is None
    assert access.authenticate(key).scope is Scope.ADMIN


# --- making and listing -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_key_is_shown_once_and_stored_as_a_hash(server: LiveServer, admin: httpx.Client) -> None:
    response = admin.post("/v1/keys", json={"scope": "viewer", "label": "a map"})
    made = response.json()
    assert response.headers["location"] == f"/v1/keys/{made['id']}"
    assert response.headers["cache-control"] == "private, no-store"
    key = made.pop("key")
    assert FORM.fullmatch(key)
    assert made["prefix"] == key[:11]
    assert made["holder_id"] == made["id"]
    assert (made["scope"], made["label"], made["valid"], made["last_used_at"]) == ("viewer", "a map", True, None)
    assert admin.get(f"/v1/keys/{made['id']}").json() == made
    listed = admin.get("/v1/keys")
    assert made in listed.json()["items"]
    assert key not in listed.text
    assert "sha256" not in listed.text
    secret = key.split("_")[2]
    database = server.app.state.database
    with database.read() as connection:
        stored = [str(row) for name in metadata.tables for row in connection.execute(sa.select(metadata.tables[name]))]
    assert not any(secret in row for row in stored)
    assert any(made["prefix"] in row for row in stored)


def test_the_audit_log_names_keys_and_who_made_them(server: LiveServer, admin: httpx.Client) -> None:
    made = _made(admin, label="crew 7", scope="surveyor")
    newer = admin.post(f"/v1/keys/{made['id']}/rotate", json={}).json()
    assert admin.delete(f"/v1/keys/{made['id']}").status_code == 204
    caller = server.app.state.use_cases.access.authenticate(admin.headers["authorization"].split()[1])
    with server.app.state.database.read() as connection:
        entries = list_entries(connection, caller.agency_id)[1:]  # the first is the admin's own key
    assert {entry.key_id for entry in entries} == {caller.key_id}
    told = [(entry.action, entry.subject) for entry in entries if entry.action.startswith("key.")]
    assert told == [("key.created", made["id"]), ("key.rotated", newer["id"]), ("key.revoked", made["id"])]
    assert entries[0].detail["label"] == "crew 7"
    assert made["key"].split("_")[2] not in str(entries)


def test_pages_of_keys(admin: httpx.Client) -> None:
    made = [_made(admin, label=f"key {n}")["id"] for n in range(4)]
    seen, url = [], "/v1/keys?limit=2"
    while url:
        page = admin.get(url)
        seen += [item["id"] for item in page.json()["items"]]
        url = page.links["next"]["url"] if "next" in page.links else ""
    assert seen[1:] == made  # the first is the admin's own


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"scope": "write"}, "scope"),
        ({"scope": None}, "scope"),
        ({"scope": ["admin"]}, "scope"),
        ({"label": ""}, "label"),
        ({"label": "   "}, "label"),
        ({"label": "a\nb"}, "label"),
        ({"label": "x" * 201}, "label"),
        ({"label": 7}, "label"),
        ({"expires_at": "2020-01-01T00:00:00Z"}, "expires_at"),
        ({"expires_at": "9999-12-31T23:59:59-14:00"}, "expires_at"),
        ({"expires_at": "0000-01-01T00:00:00Z"}, "expires_at"),
        ({"expires_at": "2027-01-01T00:00:00"}, "expires_at"),
        ({"expires_at": 1e300}, "expires_at"),
        ({"secret": "x"}, "secret"),
    ],
)
def test_bad_keys_are_refused(admin: httpx.Client, body: dict[str, Any], field: str) -> None:
    before = admin.get("/v1/keys").json()
    refused(admin.post("/v1/keys", json={"scope": "viewer", "label": "x"} | body), 422, field=field)
    after = admin.get("/v1/keys").json()
    for item in (*before["items"], *after["items"]):
        item.pop("last_used_at")
    assert after == before


# --- their end ----------------------------------------------------------------------------------------------------


def test_a_key_expires(database: Database) -> None:
    clock = Clock()
    access = Access(database, clock)
    key = access.create_key("agency", Scope.VIEWER, "x", NOW + timedelta(hours=1))
    clock.now = NOW + timedelta(seconds=3599)
    access.authenticate(key)
    clock.now = NOW + timedelta(hours=1)
    with pytest.raises(NotAuthenticated, match="expired"):
        access.authenticate(key)


def test_a_revoked_key_ends_at_once_and_for_ever(server: LiveServer, admin: httpx.Client) -> None:
    made = _made(admin)
    assert _works(server, made["key"])
    assert admin.delete(f"/v1/keys/{made['id']}").status_code == 204
    assert not _works(server, made["key"])
    listed = admin.get(f"/v1/keys/{made['id']}").json()
    assert listed["valid"] is False
    assert admin.delete(f"/v1/keys/{made['id']}").status_code == 204
    assert admin.get(f"/v1/keys/{made['id']}").json()["revoked_at"] == listed["revoked_at"]
    assert "ended" in refused(admin.post(f"/v1/keys/{made['id']}/rotate", json={}), 409, field="key_id")["detail"]


def test_the_last_admin_key_stays(server: LiveServer, admin: httpx.Client) -> None:
    [own] = admin.get("/v1/keys").json()["items"]
    _made(admin, scope="planner")
    assert "last valid admin key" in refused(admin.delete(f"/v1/keys/{own['id']}"), 409, field="key_id")["detail"]
    other = _made(admin, scope="admin", label="deputy")
    assert admin.delete(f"/v1/keys/{own['id']}").status_code == 204
    assert admin.get("/v1/keys").status_code == 401
    assert _works(server, other["key"])


# --- rotation -----------------------------------------------------------------------------------------------------


def test_both_keys_are_valid_for_the_overlap(database: Database) -> None:
    clock = Clock()
    access = Access(database, clock)
    keys = Keys(database, clock, access)
    admin = access.authenticate(access.create_key("agency", Scope.ADMIN, "admin"))
    old = keys.create(admin, NewKey(Scope.VEHICLE, "BUS-7", NOW + timedelta(days=90)))
    holder = access.authenticate(old["key"])
    clock.now += timedelta(days=80)
    new = keys.rotate(admin, old["id"], overlap=timedelta(hours=2))
    assert new["expires_at"] == clock.now + timedelta(days=90)
    assert (new["scope"], new["label"], new["holder_id"]) == ("vehicle", "BUS-7", old["holder_id"])
    assert access.authenticate(old["key"]) == access.authenticate(new["key"]) == holder
    clock.now += timedelta(hours=2)
    with pytest.raises(NotAuthenticated):
        access.authenticate(old["key"])
    newest = keys.rotate(admin, new["id"], overlap=timedelta(0))
    with pytest.raises(NotAuthenticated):
        access.authenticate(new["key"])
    assert access.authenticate(newest["key"]) == holder


def test_a_rotation_never_makes_the_old_key_last_longer(database: Database) -> None:
    clock = Clock()
    access = Access(database, clock)
    keys = Keys(database, clock, access)
    admin = access.authenticate(access.create_key("agency", Scope.ADMIN, "admin"))
    old = keys.create(admin, NewKey(Scope.VIEWER, "x", NOW + timedelta(hours=1)))
    keys.rotate(admin, old["id"], overlap=timedelta(days=1))
    assert keys.get(admin, old["id"])["expires_at"] == NOW + timedelta(hours=1)


def test_rotation_through_the_api(server: LiveServer, admin: httpx.Client) -> None:
    old = _made(admin)
    answer = admin.post(f"/v1/keys/{old['id']}/rotate", json={"overlap_s": 3600})
    new = answer.json()
    assert answer.status_code == 201
    assert answer.headers["cache-control"] == "private, no-store"
    assert _works(server, old["key"])
    assert _works(server, new["key"])
    assert new["expires_at"] is None
    left = datetime.fromisoformat(admin.get(f"/v1/keys/{old['id']}").json()["expires_at"]) - datetime.now(UTC)
    assert timedelta(minutes=58) < left <= timedelta(hours=1)
    assert new["id"] in refused(admin.post(f"/v1/keys/{old['id']}/rotate", json={}), 409, field="key_id")["detail"]
    for bad in (-1, 2_592_001, 1.5, "1", 10**15, True):
        refused(admin.post(f"/v1/keys/{new['id']}/rotate", json={"overlap_s": bad}), 422, field="overlap_s")


def test_a_vehicle_keeps_its_decodes_when_its_key_is_replaced(database: Database) -> None:
    access = Access(database, Clock())
    keys = Keys(database, Clock(), access)
    admin = access.authenticate(access.create_key("agency", Scope.ADMIN, "admin"))
    old = keys.create(admin, NewKey(Scope.VEHICLE, "BUS-7"))
    new = keys.rotate(admin, old["id"], overlap=timedelta(0))
    assert access.authenticate(new["key"]).own_key_id == old["id"]
    assert admin.own_key_id is None


# --- last use -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_uses_are_written_together_and_no_request_waits_for_it(database: Database) -> None:
    clock = Clock()
    access = Access(database, clock)
    keys = Keys(database, clock, access)
    caller: Caller = access.authenticate(access.create_key("agency", Scope.ADMIN, "admin"))
    made = keys.create(caller, NewKey(Scope.VIEWER, "x"))
    access.write_uses()
    written: list[str] = []
    sa.event.listen(
        database.engine, "before_cursor_execute", lambda *args: written.append(args[2]) if "UPDATE" in args[2] else None
    )
    for second in range(100):
        clock.now = NOW + timedelta(seconds=second)
        access.authenticate(made["key"])
    assert written == []
    assert keys.get(caller, made["id"])["last_used_at"] == clock.now
    access.write_uses()
    access.write_uses()
    assert len(written) == 1
    assert _stored_use(database, made["id"]) == clock.now
    assert Keys(database, clock, Access(database, clock)).get(caller, made["id"])["last_used_at"] == clock.now


def test_uses_wait_while_the_database_is_busy(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    access = Access(database, Clock())
    key = access.create_key("agency", Scope.ADMIN, "admin")
    key_id = access.authenticate(key).key_id
    monkeypatch.setattr("app.registry.database.BUSY_TIMEOUT_S", 0.01)
    with database.write():
        access.write_uses()
    assert _stored_use(database, key_id) is None
    access.write_uses()
    assert _stored_use(database, key_id) == NOW


def _stored_use(database: Database, key_id: str) -> datetime | None:
    with database.read() as connection:
        query = sa.select(api_keys.c.last_used_at).where(api_keys.c.id == key_id)
        at: datetime | None = connection.execute(query).scalar_one()
        return at
