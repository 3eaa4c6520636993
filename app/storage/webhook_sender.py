"""Requests to addresses that clients chose. They reach public addresses only, whatever a name resolves to.

The name is resolved once, every address in the answer is checked, and the connection goes to a checked one: a name
that resolves differently a moment later (DNS rebinding) changes nothing.
"""

from __future__ import annotations

import asyncio
import ipaddress
import re
import socket
import ssl
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import NamedTuple
from urllib.parse import SplitResult, urlsplit

from app.errors import InvalidParameter

TOTAL_S = 10.0
"""Longest time of a request, from resolving the name to the end of the response. [s] Source: Standard Webhooks has
15 to 30 s; a receiver should answer first and work then."""
MAX_RESPONSE_BYTES = 16 * 1024
"""Read of a response, and thrown away. [byte]"""
MAX_URL = 500
_GLOBAL_V6 = ipaddress.ip_network("2000::/3")  # all that IANA has assigned to hosts
_FORBIDDEN = tuple(
    ipaddress.ip_network(text)
    for text in (  # IANA's registries of special-purpose addresses; Python's own list differs between its versions
        "0.0.0.0/8",
        "10.0.0.0/8",
        "100.64.0.0/10",  # shared by customers of a provider, RFC 6598
        "127.0.0.0/8",
        "169.254.0.0/16",
        "172.16.0.0/12",
        "192.0.0.0/24",  # protocol assignments, RFC 6890
        "192.0.2.0/24",
        "192.88.99.0/24",  # relays of 6to4, RFC 7526
        "192.168.0.0/16",
        "198.18.0.0/15",  # measurements of networks, RFC 2544
        "198.51.100.0/24",
        "203.0.113.0/24",
        "224.0.0.0/3",  # multicast and reserved
        "2001::/23",  # protocol assignments, Teredo (RFC 4380) among them: reaches IPv4 addresses
        "2001:db8::/32",
        "2002::/16",  # 6to4, RFC 3056: reaches IPv4 addresses
        "3fff::/20",  # documentation, RFC 9637
    )
)
_LOCAL_NAMES = ("localhost", "local", "localdomain", "internal", "home.arpa", "onion", "invalid")
"""Last labels of names that are not in the public DNS. Source: RFC 6761, 6762, 7686, 8375; ICANN for `internal`."""
_LABEL = re.compile(r"[a-z0-9_]([a-z0-9_-]{0,61}[a-z0-9])?", re.IGNORECASE)
_NUMBER = re.compile(r"[0-9]+|0[xX][0-9a-fA-F]*")  # as a last label: an IPv4 address in the WHATWG's URLs
_MAX_NAME = 253
_REGISTRATION_S = 3.0
"""How long a registration waits for the addresses of a name. [s] A delivery checks them in any case."""
_RESOLVER = ThreadPoolExecutor(64, "resolver")
"""Threads for lookups, which cannot be stopped. Twice as many as deliveries at once, because slow names occupy them."""
Resolve = Callable[[str, int], list[str]]
"""Addresses of a host; it is called in a thread."""


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
    if isinstance(found, ipaddress.IPv6Address) and (found not in _GLOBAL_V6 or found.scope_id is not None):
        return False
    return found.is_global and not any(found.version == net.version and found in net for net in _FORBIDDEN)


def check_url(url: str, *, loopback: bool = False) -> SplitResult:
    """The parts of a URL that webhooks may have: https, a public name or address, port 443 or one above 1023.

    Names are not resolved here.

    Parameters
    ----------
    loopback : bool, optional
        Also http, and any name.

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
    if (port is not None and port != 443 and port < 1024) or parts.netloc.endswith(":"):
        raise _refused(f"port {port or 'missing'} belongs to another service")
    _check_host(parts.hostname, "[" in parts.netloc, loopback=loopback)
    return parts


def _check_host(host: str, in_brackets: bool, *, loopback: bool) -> None:
    """A name of the public DNS, a dotted IPv4 address or an IPv6 address: no other spelling of an address."""
    labels = host.split(".")
    if in_brackets or _NUMBER.fullmatch(labels[-1]):
        try:
            address = ipaddress.ip_address(host)
        except ValueError as error:
            raise _refused("its host is neither a name nor an address in the usual spelling") from error
        if not is_public(host) and not (loopback and address.is_loopback):
            raise _refused("its address is not public")
        return
    if len(host) > _MAX_NAME or not all(map(_LABEL.fullmatch, labels)):
        raise _refused("its host is not a name: labels of letters, digits and hyphens, 63 characters each, 253 in all")
    if not loopback and (len(labels) < 2 or f".{host}".endswith(tuple(f".{name}" for name in _LOCAL_NAMES))):
        raise _refused("its host is a name of a local network")


def _refused(why: str) -> InvalidParameter:
    return InvalidParameter(
        f"the URL cannot be used: {why}",
        field="url",
        limit=f"https://HOST[:PORT]/PATH at a public address, ASCII, {MAX_URL} characters, port 443 or one above 1023",
        cure="give the https address at which the receiver can be reached from the internet",
    )


def resolve(host: str, port: int) -> list[str]:
    """Addresses of a host by the system's resolver.

    Raises
    ------
    OSError
        It has none, or no server answers.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except UnicodeError as error:  # of the IDNA codec, for names that no server would know
        raise socket.gaierror(socket.EAI_NONAME, "the name is not valid") from error
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
    """

    def __init__(
        self, resolve: Resolve = resolve, *, loopback: bool = False, tls: ssl.SSLContext | None = None,
        total_s: float = TOTAL_S,
    ) -> None:  # fmt: skip
        self._resolve, self._loopback, self._total_s = resolve, loopback, total_s
        self._tls = tls

    @cached_property
    def _context(self) -> ssl.SSLContext:
        """Reading the authorities takes 30 ms, so it is done once."""
        return self._tls or ssl.create_default_context()

    def check_url(self, url: str) -> None:
        """Refuse a URL that cannot be used, as InvalidParameter.

        A name that has no address at the moment is accepted: each delivery resolves it again.
        """
        parts = check_url(url, loopback=self._loopback)
        try:
            addresses = _RESOLVER.submit(self._resolve, parts.hostname or "", _port(parts)).result(_REGISTRATION_S)
        except (OSError, TimeoutError):
            return
        if not all(map(self._may_reach, addresses)):
            raise _refused("its host has an address that is not public")

    async def send(self, url: str, headers: Mapping[str, str], body: bytes) -> Sent:
        """Post a body. It raises nothing: whatever happens is the outcome."""
        import httpx  # here and below: most servers send no webhook

        try:
            async with asyncio.timeout(self._total_s):
                return await self._send(url, headers, body)
        except TimeoutError:
            return Sent(None, f"no response within {self._total_s:g} s")
        except (AddressRefused, InvalidParameter) as error:
            return Sent(None, str(error))
        except socket.gaierror as error:
            return Sent(None, f"the host's name cannot be resolved: {error.strerror or error}")
        except (httpx.HTTPError, httpx.InvalidURL, ssl.SSLError, OSError, ValueError) as error:
            return Sent(None, f"{type(error).__name__}: {error}"[:300])

    async def _send(self, url: str, headers: Mapping[str, str], body: bytes) -> Sent:
        import httpx

        parts = check_url(url, loopback=self._loopback)
        host, port = parts.hostname or "", _port(parts)
        address = await self._checked_address(host, port)
        pinned = httpx.URL(url).copy_with(host=address, port=port)
        sent = {**headers, "Host": parts.netloc, "Content-Type": "application/json", "User-Agent": "Waymark-Webhooks/1"}
        async with (
            httpx.AsyncClient(
                verify=self._context,
                follow_redirects=False,
                trust_env=False,
                timeout=self._total_s,
            ) as client,
            client.stream("POST", pinned, content=body, headers=sent, extensions={"sni_hostname": host}) as response,
        ):
            read = 0
            async for part in response.aiter_raw():
                read += len(part)
                if read > MAX_RESPONSE_BYTES:
                    break
            status = response.status_code
        return Sent(status, None if 200 <= status < 300 else f"status {status}")

    async def _checked_address(self, host: str, port: int) -> str:
        """An address of a host, if all that it has are public."""
        addresses = await asyncio.get_running_loop().run_in_executor(_RESOLVER, self._resolve, host, port)
        if not addresses:
            raise AddressRefused("the host has no address")
        if not all(map(self._may_reach, addresses)):
            raise AddressRefused("the host's address is not public")
        return addresses[0]

    def _may_reach(self, address: str) -> bool:
        return is_public(address) or (self._loopback and ipaddress.ip_address(address).is_loopback)


def _port(parts: SplitResult) -> int:
    return parts.port or (443 if parts.scheme == "https" else 80)
