"""Requests to addresses that clients chose. They reach public addresses only, whatever a name resolves to.

The name is resolved once, every address in the answer is checked, and the connection goes to a checked one: a name
that resolves differently a moment later (DNS rebinding) changes nothing.
"""

from __future__ import annotations

import asyncio
import ipaddress
import socket
import ssl
from collections.abc import Awaitable, Callable, Mapping
from typing import NamedTuple
from urllib.parse import SplitResult, urlsplit

import httpx

from app.errors import InvalidParameter

TOTAL_S = 10.0
"""Longest time of a request, from resolving the name to the end of the response. [s] Source: Standard Webhooks has
15 to 30 s; a receiver should answer first and work then."""
MAX_RESPONSE_BYTES = 16 * 1024
"""Read of a response, and thrown away. [byte]"""
MAX_URL = 500
_FORBIDDEN = tuple(
    ipaddress.ip_network(text)
    for text in (
        "64:ff9b::/96",  # NAT64, RFC 6052: reaches IPv4 addresses of the network
        "64:ff9b:1::/48",  # NAT64 of a local network, RFC 8215
        "2002::/16",  # 6to4, RFC 3056
        "2001::/32",  # Teredo, RFC 4380
        "::/96",  # addresses compatible with IPv4, RFC 4291
        "fec0::/10",  # site-local, RFC 3879
        "192.88.99.0/24",  # relays of 6to4, RFC 7526
    )
)
Resolve = Callable[[str, int], Awaitable[list[str]]]
"""Addresses of a host."""


class AddressRefused(Exception):
    """A URL leads to an address that is not public."""


class Sent(NamedTuple):
    """How a request ended: with a status, or with what went wrong."""

    status: int | None
    error: str | None

    @property
    def succeeded(self) -> bool:
        """Whether the receiver took it."""
        return self.status is not None and 200 <= self.status < 300


def is_public(address: str) -> bool:
    """Whether an address is of the public internet, and one of a single host."""
    try:
        found = ipaddress.ip_address(address)
    except ValueError:
        return False
    if isinstance(found, ipaddress.IPv6Address) and found.ipv4_mapped is not None:
        return False
    if found.is_multicast or found.is_unspecified or not found.is_global:
        return False
    return not any(found.version == network.version and found in network for network in _FORBIDDEN)


def check_url(url: str, *, loopback: bool = False) -> SplitResult:
    """The parts of a URL that webhooks may have: https, without user, on port 443 or one above 1023.

    Parameters
    ----------
    url : str
    loopback : bool, optional
        Also http.

    Raises
    ------
    InvalidParameter
    """
    schemes = ("https", "http") if loopback else ("https",)
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise _refused("it cannot be read") from error
    if len(url) > MAX_URL or not url.isascii() or not url.isprintable() or any(c in url for c in " \\"):
        raise _refused(f"it has other characters than ASCII, or over {MAX_URL}")
    if parts.scheme not in schemes or not parts.hostname:
        raise _refused("it is no https URL")
    if parts.username is not None or parts.password is not None or parts.fragment:
        raise _refused("it has a user or a fragment")
    if port is not None and port != 443 and port < 1024:
        raise _refused(f"port {port} belongs to another service")
    return parts


def _refused(why: str) -> InvalidParameter:
    return InvalidParameter(
        f"the URL cannot be used: {why}", field="url",
        limit=f"https://HOST[:PORT]/PATH, ASCII, {MAX_URL} characters, port 443 or one above 1023",
    )  # fmt: skip


async def resolve(host: str, port: int) -> list[str]:
    """Addresses of a host by the system's resolver."""
    found = await asyncio.get_running_loop().getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(str(address[0]) for *_, address in found))


class WebhookSender:
    """Posts to URLs of clients.

    Parameters
    ----------
    resolve : callable, optional
        Addresses of a host.
    loopback : bool, optional
        Loopback addresses and http are allowed: for trying out on one machine.
    tls : SSLContext, optional
        The system's authorities by default.
    total_s : float, optional
    """

    def __init__(
        self, resolve: Resolve = resolve, *, loopback: bool = False, tls: ssl.SSLContext | None = None,
        total_s: float = TOTAL_S,
    ) -> None:  # fmt: skip
        self._resolve, self._loopback, self._total_s = resolve, loopback, total_s
        self._tls = tls

    def check_url(self, url: str) -> None:
        """Refuse a URL that cannot be used, as InvalidParameter."""
        check_url(url, loopback=self._loopback)

    async def send(self, url: str, headers: Mapping[str, str], body: bytes) -> Sent:
        """Post a body. It raises nothing: whatever happens is the outcome."""
        try:
            async with asyncio.timeout(self._total_s):
                return await self._send(url, headers, body)
        except TimeoutError:
            return Sent(None, f"no response within {self._total_s:g} s")
        except (AddressRefused, InvalidParameter) as error:
            return Sent(None, str(error))
        except socket.gaierror as error:
            return Sent(None, f"the host's name cannot be resolved: {error.strerror or error}")
        except (httpx.HTTPError, httpx.InvalidURL, ssl.SSLError, OSError) as error:
            return Sent(None, f"{type(error).__name__}: {error}"[:300])

    async def _send(self, url: str, headers: Mapping[str, str], body: bytes) -> Sent:
        parts = check_url(url, loopback=self._loopback)
        host = parts.hostname or ""
        port = parts.port or (443 if parts.scheme == "https" else 80)
        address = await self._checked_address(host, port)
        pinned = httpx.URL(url).copy_with(host=address, port=port)
        sent = {**headers, "Host": parts.netloc, "Content-Type": "application/json", "User-Agent": "Waymark-Webhooks/1"}
        async with (
            httpx.AsyncClient(
                verify=self._tls or ssl.create_default_context(), follow_redirects=False, trust_env=False,
                timeout=self._total_s,
            ) as client,
            client.stream(
                "POST", pinned, content=body, headers=sent, extensions={"sni_hostname": host}
            ) as response,
        ):  # fmt: skip
            read = 0
            async for part in response.aiter_raw():
                read += len(part)
                if read > MAX_RESPONSE_BYTES:
                    break
            status = response.status_code
        return Sent(status, None if 200 <= status < 300 else f"status {status}")

    async def _checked_address(self, host: str, port: int) -> str:
        """An address of a host, if all that it has are public."""
        addresses = await self._resolve(host, port)
        if not addresses:
            raise AddressRefused("the host has no address")
        for address in addresses:
            if not is_public(address) and not (self._loopback and ipaddress.ip_address(address).is_loopback):
                raise AddressRefused("the host's address is not public")
        return addresses[0]
