"""The fleet's files: compose, the proxy in front of two real servers, secrets, Kubernetes manifests."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import jsonschema_rs
import kubernetes_validate
import pytest
import yaml

from app.cli.database import read_settings
from app.demo.server import free_ports
from app.main import create_app
from app.settings import Settings
from tests.api.http.test_permissions import list_routes
from tests.conftest import ADMIN_KEY
from tests.databases import PostgresServer
from tests.docker.test_image import serving
from tests.http import WITHIN_S, wait_until

ROOT = Path(__file__).resolve().parents[2]
FLEET = ROOT / "docker/compose.fleet.yaml"
MANIFESTS = sorted((ROOT / "docker/kubernetes").glob("*.yaml"))
VERSIONS = ("1.29", "1.33", "1.37")
COMMANDS = {"serve", "worker", "migrate"}


def compose() -> dict[str, Any]:
    return dict(yaml.safe_load(FLEET.read_text()))


def manifests() -> list[dict[str, Any]]:
    return [document for path in MANIFESTS for document in yaml.safe_load_all(path.read_text())]


def test_every_service_is_pinned_hardened_limited_and_started_in_order() -> None:
    document = compose()
    services = document["services"]
    assert {
        "proxy",
        "api-1",
        "api-2",
        "worker-online",
        "worker-proof",
        "worker-archive",
        "db",
        "broker",
        "store",
    } <= set(services)
    for name, service in services.items():
        assert service["image"] == "waymark" or re.search(r"@sha256:[0-9a-f]{64}$", service["image"]), name
        assert "no-new-privileges:true" in service["security_opt"], name
        limits = service["deploy"]["resources"]["limits"]
        assert limits["cpus"], name
        assert limits["memory"], name
        for other, wanted in service.get("depends_on", {}).items():
            condition = wanted["condition"]
            assert condition == "service_completed_successfully" or condition == "service_healthy", name
            if condition == "service_healthy":
                checked = services[other]
                assert "healthcheck" in checked or checked["image"] == "waymark", other  # the image has a check itself
        for secret in service.get("secrets", ()):
            assert (secret if isinstance(secret, str) else secret["source"]) in document["secrets"], name
        if service["image"] == "waymark":
            assert service["read_only"], name
            assert service["cap_drop"] == ["ALL"], name
            assert service["user"] == "10001:10001", name
            assert service.get("command", ["waymark", "serve"])[1] in COMMANDS
    assert {
        volume.split(":")[0] for s in services.values() for volume in s.get("volumes", ()) if volume[0] != "."
    } == set(document["volumes"])


def test_settings_and_files_of_the_fleet_exist() -> None:
    known = {f"WAYMARK_{name.upper()}" for name in Settings.model_fields}
    texts = [FLEET, ROOT / "docker/fleet/nginx.conf", *MANIFESTS]
    for path in texts:
        assert set(re.findall(r"WAYMARK_[A-Z_]+[A-Z]", path.read_text())) <= known, path.name
    for source in re.findall(r"(\./fleet/[\w./-]+)", FLEET.read_text()):
        assert source.startswith("./fleet/secrets/") or (ROOT / "docker" / source).exists(), source


def test_the_secrets_are_what_compose_and_the_settings_ask_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = ROOT / "docker/fleet/make-secrets.sh"
    subprocess.run(["sh", str(script), str(tmp_path / "secrets")], check=True)
    assert (
        subprocess.run(["sh", str(script), str(tmp_path / "secrets")], check=False, capture_output=True).returncode == 1
    )
    made = {path.name for path in (tmp_path / "secrets").iterdir()}
    asked = {Path(secret["file"]).name for secret in compose()["secrets"].values()}
    assert asked == made
    json.loads((tmp_path / "secrets/s3.json").read_bytes())
    monkeypatch.setenv("WAYMARK_SECRETS_DIR", str(tmp_path / "secrets"))
    monkeypatch.setenv("WAYMARK_BLOBS_URL", "s3://waymark/blobs")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "")
    settings = read_settings()
    password = (tmp_path / "secrets/waymark_role_password").read_text()
    assert f":{password}@db:5432/waymark" in settings.database_url
    assert settings.admin_key is not None


# --- the proxy ------------------------------------------------------------------------------------------------------


@contextmanager
def proxy(folder: Path, servers: list[str], find: Callable[..., str]) -> Iterator[str]:
    """The real nginx with the real file; only names, ports and the rate are changed."""
    (port,) = free_ports(1)
    text = (ROOT / "docker/fleet/nginx.conf").read_text().replace("listen 8080", f"listen 127.0.0.1:{port}")
    for name, url in zip(("api-1:8000", "api-2:8000"), servers, strict=True):
        text = text.replace(name, url.removeprefix("http://"))
    text = text.replace("rate=200r/s", "rate=1r/s").replace("burst=1000", "burst=30").replace("/tmp/", f"{folder}/")
    (folder / "nginx.conf").write_text(text)
    command = [find("nginx"), "-p", str(folder), "-c", "nginx.conf", "-g", "daemon off;"]
    checked = subprocess.run([*command[:-2], "-t"], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            url = f"http://127.0.0.1:{port}"
            wait_until(lambda: answers(url), "the proxy")
            yield url
        finally:
            process.terminate()


def answers(url: str) -> bool:
    """Whether a server answers; one that starts is asked again rather than waited for."""
    try:
        return httpx.get(f"{url}/healthz", trust_env=False, timeout=10).status_code == 200
    except httpx.TransportError:
        return False


@pytest.mark.slow
def test_two_servers_behind_the_proxy_share_rows_limits_and_failures(
    tmp_path: Path, postgres: PostgresServer, require_tool: Callable[..., str]
) -> None:
    tmp_path.chmod(0o755)
    own = {"WAYMARK_DATABASE_URL": postgres.empty(), "WAYMARK_ADMIN_KEY": ADMIN_KEY}
    key = {"Authorization": f"Bearer {ADMIN_KEY}"}
    with ExitStack() as stack:
        first = stack.enter_context(serving(ROOT, tmp_path / "var", drop=False, **own))
        with (
            serving(ROOT, tmp_path / "var", drop=False, **own) as second,
            proxy(tmp_path, [first, second], require_tool) as url,
        ):
            with httpx.Client(base_url=url, headers=key, trust_env=False, timeout=WITHIN_S) as client:
                marker = client.post("/v1/markers", json={"position": {"lon_deg": 8.4, "lat_deg": 49.0}})
                assert marker.status_code == 201, marker.text
                assert client.get("/metrics").status_code == 404
                statuses = [client.get(f"/v1/markers/{marker.json()['id']}").status_code for _ in range(10)]
                assert set(statuses) == {200}
                counted = [served(server) for server in (first, second)]
                assert min(counted) > 0, "both servers answer"
                many = [client.get("/healthz") for _ in range(60)]
                refused = [response for response in many if response.status_code == 429]
                assert refused, "one key's rate is limited over both servers"
                assert refused[0].headers["retry-after"] == "1"
                assert refused[0].headers["content-type"] == "application/problem+json"
                assert refused[0].json()["status"] == 429
            other = httpx.get(
                f"{url}/v1/markers",
                headers={"X-API-Key": "another-key-that-is-wrong"},
                trust_env=False,
                timeout=WITHIN_S,
            )
            assert other.status_code == 401, "another client has its own limit"
        # the second server has stopped, the proxy too; a new one sends what the stopped one would get to the other
        with proxy(tmp_path, [first, second], require_tool) as url:
            found = [httpx.get(f"{url}/healthz", trust_env=False, timeout=WITHIN_S).status_code for _ in range(8)]
            assert set(found) == {200}


def served(url: str) -> float:
    """Requests for a marker that a server has answered."""
    text = httpx.get(f"{url}/metrics", trust_env=False, timeout=WITHIN_S).text
    pattern = r'^waymark_http_requests_total\{.*route="/v1/markers/\{marker_id\}".*\} ([\d.]+)$'
    return sum(map(float, re.findall(pattern, text, re.MULTILINE)))


# --- routes through the proxies -------------------------------------------------------------------------------------

INSIDE = {"/metrics", "/readyz"}
"""For Prometheus and the kubelet, not for clients: the ingress does not route them."""


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Path templates of all that the server answers, from the application itself."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("routes"), admin_key=ADMIN_KEY)
    return {route.partition(" ")[2] for route in list_routes(create_app(settings))}


def routed_by_ingress(path: str) -> bool:
    """Whether the ingress sends a path to the server: Exact by characters, Prefix by whole elements."""
    (ingress,) = (document for document in manifests() if document["kind"] == "Ingress")
    for rule in ingress["spec"]["rules"]:
        for entry in rule["http"]["paths"]:
            assert entry["backend"]["service"] == {"name": "waymark-api", "port": {"name": "http"}}
            is_prefix = entry["pathType"] == "Prefix"
            if path == entry["path"] or (is_prefix and path.startswith(entry["path"].rstrip("/") + "/")):
                return True
    return False


def location_of(configuration: str, path: str) -> str:
    """The body of nginx's location for a path: an exact one, or else that with the longest prefix."""
    found = re.findall(r"^ +location (=?) *(/\S*) \{(.*?)^ +\}", configuration, re.MULTILINE | re.DOTALL)
    exact = [body for kind, name, body in found if kind == "=" and name == path]
    prefixes = {name: body for kind, name, body in found if not kind and path.startswith(name)}
    return exact[0] if exact else prefixes[max(prefixes, key=len)]


def test_the_ingress_routes_every_path_of_the_server(paths: set[str]) -> None:
    asked = {re.sub(r"\{\w+(:\w+)?\}", "x", path) for path in paths}
    assert {path for path in asked if not routed_by_ingress(path)} == INSIDE
    assert routed_by_ingress("/static/app/main.js")
    assert routed_by_ingress("/guide/index.html")
    assert not routed_by_ingress("/metricsx")


@pytest.mark.parametrize("name", ["docker/nginx.conf", "docker/fleet/nginx.conf"])
def test_nginx_routes_every_path_of_the_server(paths: set[str], name: str) -> None:
    text = (ROOT / name).read_text()
    asked = {re.sub(r"\{\w+(:\w+)?\}", "x", path) for path in paths}
    unrouted = {path for path in asked if "proxy_pass http://waymark;" not in location_of(text, path)}
    assert unrouted <= {"/metrics"}, name


# --- Kubernetes -----------------------------------------------------------------------------------------------------

# Only the fields that these manifests use, written down from https://keda.sh/docs/latest/reference/scaledobject-spec/
# and https://keda.sh/docs/latest/scalers/rabbitmq-queue/; it is not KEDA's own schema.
REFERENCE = {
    "type": "object",
    "additionalProperties": False,
    "required": ["name"],
    "properties": {name: {"type": "string"} for name in ("apiVersion", "kind", "name")},
}
SCALED_OBJECT = {
    "type": "object",
    "additionalProperties": False,
    "required": ["scaleTargetRef", "triggers"],
    "properties": {
        "scaleTargetRef": REFERENCE,
        **{
            name: {"type": "integer", "minimum": 0}
            for name in ("minReplicaCount", "maxReplicaCount", "pollingInterval", "cooldownPeriod")
        },
        "triggers": {
            "type": "array",
            "minItems": 1,
            "items": {
                "type": "object",
                "additionalProperties": False,
                "required": ["type", "metadata"],
                "properties": {
                    "type": {"const": "rabbitmq"},
                    "authenticationRef": REFERENCE,
                    "metadata": {
                        "type": "object",
                        "additionalProperties": False,
                        "required": ["protocol", "queueName", "mode", "value"],
                        "properties": {
                            "protocol": {"enum": ["amqp", "http", "auto"]},
                            "queueName": {"type": "string"},
                            "mode": {"enum": ["QueueLength", "MessageRate"]},
                            "value": {"type": "string", "pattern": "^[0-9]+$"},
                        },
                    },
                },
            },
        },
    },
}
TRIGGER_AUTHENTICATION = {
    "type": "object",
    "additionalProperties": False,
    "required": ["secretTargetRef"],
    "properties": {
        "secretTargetRef": {
            "type": "array",
            "items": {
                "type": "object",
                "additionalProperties": False,
                "required": ["parameter", "name", "key"],
                "properties": {name: {"type": "string"} for name in ("parameter", "name", "key")},
            },
        }
    },
}
KEDA = {"ScaledObject": SCALED_OBJECT, "TriggerAuthentication": TRIGGER_AUTHENTICATION}


@pytest.mark.parametrize("version", VERSIONS)
def test_manifests_are_as_kubernetes_declares_them(version: str) -> None:
    kinds = set()
    for document in manifests():
        kinds.add(document["kind"])
        if document["kind"] not in KEDA:
            kubernetes_validate.validate(document, version, strict=True)
    assert kinds >= {
        "Deployment",
        "Job",
        "Service",
        "Ingress",
        "PodDisruptionBudget",
        "NetworkPolicy",
        "ConfigMap",
        *KEDA,
    }


def test_a_manifest_with_an_unknown_member_is_refused() -> None:
    document = next(m for m in manifests() if m["kind"] == "Deployment")
    document["spec"]["template"]["spec"]["containers"][0]["readOnly"] = True
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(document, VERSIONS[0], strict=True)


def test_scaling_is_by_the_length_of_each_workers_queue() -> None:
    found = manifests()
    workers = {m["metadata"]["name"]: m for m in found if m["metadata"].get("labels", {}).get("part") == "worker"}
    prefix = Settings().model_dump().get("broker_prefix", "waymark")
    scaled = [m for m in found if m["kind"] in KEDA]
    for document in scaled:
        assert set(document) == {"apiVersion", "kind", "metadata", "spec"}
        assert document["apiVersion"] == "keda.sh/v1alpha1"
        faults = list(jsonschema_rs.Draft202012Validator(KEDA[document["kind"]]).iter_errors(document["spec"]))
        assert faults == [], document["metadata"]["name"]
    targets = {m["spec"]["scaleTargetRef"]["name"]: m for m in scaled if m["kind"] == "ScaledObject"}
    assert set(targets) == set(workers)
    for name, worker in workers.items():
        queue = worker["metadata"]["labels"]["queue"]
        command = worker["spec"]["template"]["spec"]["containers"][0]["command"]
        assert command == ["waymark", "worker", "--queues", queue]
        assert targets[name]["spec"]["triggers"][0]["metadata"]["queueName"] == f"{prefix}.{queue}"
        assert "replicas" not in worker["spec"]


def test_pods_are_hardened_and_take_their_secrets_by_reference() -> None:
    for document in manifests():
        if document["kind"] not in ("Deployment", "Job"):
            continue
        pod = document["spec"]["template"]["spec"]
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["automountServiceAccountToken"] is False
        assert {"secret": {"secretName": "waymark", "defaultMode": 0o440}, "name": "secrets"} in pod["volumes"]
        for container in pod["containers"]:
            assert container["securityContext"]["readOnlyRootFilesystem"] is True
            assert container["securityContext"]["allowPrivilegeEscalation"] is False
            assert container["resources"]["limits"]["memory"]
            assert "env" not in container
    assert not [m for m in manifests() if m["kind"] == "Secret"]
