"""Link strings, and the transport each of them stands for."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, cast

from vcl_companion.errors import ConfigError
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.datagram import PeerSocket, UdpClient, UdpListener
from vcl_companion.links.reconnect import Address, Backoff, OnBytes
from vcl_companion.links.stream import SerialTransport, TcpTransport

LinkKind = Literal["serial", "udp", "udpin", "tcp"]

_KINDS = ("serial", "udp", "udpin", "tcp")
_FORMS = "serial:DEVICE:BAUD, udp:HOST:PORT, udpin:HOST:PORT or tcp:HOST:PORT"
_MAX_BAUD = 20_000_000
_MAX_PEERS = 254
LINK_RECEIVE_BUFFER_BYTES = 1 << 20
# A map arrives as thousands of small datagrams while this process may be busy.
PEER_RECEIVE_BUFFER_BYTES = 4 << 20


class Transport(Protocol):
    """A link to one other side; ``write`` never waits and may drop (counted)."""

    @property
    def is_stream(self) -> bool:
        """Whether bytes arrive without boundaries; else each call is one datagram."""
        ...

    async def run(self, on_bytes: OnBytes, on_connected: Callable[[], None]) -> None:
        """Keep the link up until cancelled (see ``Reconnecting.run``)."""
        ...

    def write(self, data: bytes) -> None:
        """Send one MAVLink frame."""
        ...


@dataclass(frozen=True)
class LinkAddress:
    """A parsed link string.

    Attributes:
        kind: how it is reached.
        place: device path, or host.
        number: baud, or port.
    """

    kind: LinkKind
    place: str
    number: int


def parse_link(link: str) -> LinkAddress:
    """Read a link string.

    Raises:
        ConfigError: it is none of ``serial:DEVICE:BAUD``, ``udp:HOST:PORT`` (we send
            there and hear only that address), ``udpin:HOST:PORT`` (we listen there) and
            ``tcp:HOST:PORT``. An IPv6 host stands in brackets.
    """
    kind, _, rest = link.partition(":")
    if kind not in _KINDS:
        raise ConfigError(f"link {link!r}: expected {_FORMS}")
    if kind != "serial":
        host, port = _split_host_port(rest, f"link {link!r}")
        if port == 0 and kind != "udpin":
            raise ConfigError(f"link {link!r}: port 0 can only be listened at")
        return LinkAddress(cast(LinkKind, kind), host, port)
    device, _, baud = rest.rpartition(":")
    if not device.startswith("/"):
        raise ConfigError(
            f"link {link!r}: expected serial:DEVICE:BAUD, as in serial:/dev/serial0:921600"
        )
    speed = _bounded_int(baud, _MAX_BAUD, "baud", f"link {link!r}")
    if speed == 0:
        raise ConfigError(f"link {link!r}: baud must be above 0")
    return LinkAddress("serial", device, speed)


def open_transport(
    link: str,
    tally: LinkTally,
    *,
    allowed_senders: Sequence[str] = (),
    backoff: Backoff | None = None,
) -> Transport:
    """Return the transport of a link string; nothing is opened before it runs.

    Args:
        link: see ``parse_link``.
        tally: where it counts.
        allowed_senders: for ``udpin``, addresses or networks that may become the peer;
            empty: any.
        backoff: pauses between attempts to open.

    Raises:
        ConfigError: the link string or an allowed sender is wrong.
    """
    address = parse_link(link)
    check_allowed_senders(allowed_senders)
    backoff = backoff or Backoff()
    match address.kind:
        case "serial":
            return SerialTransport(address.place, address.number, tally, backoff)
        case "tcp":
            return TcpTransport(address.place, address.number, tally, backoff)
        case "udp":
            return UdpClient(
                address.place, address.number, LINK_RECEIVE_BUFFER_BYTES, tally, backoff
            )
        case "udpin":
            return UdpListener(
                address.place,
                address.number,
                allowed_senders,
                LINK_RECEIVE_BUFFER_BYTES,
                tally,
                backoff,
            )


def check_allowed_senders(allowed_senders: Sequence[str]) -> None:
    """Raise ConfigError unless every entry is an IP address or network."""
    for text in allowed_senders:
        try:
            ipaddress.ip_network(text, strict=False)
        except ValueError as error:
            raise ConfigError(f"allowed_senders: {error}") from error


def parse_peers(listen: str, to: Sequence[str]) -> tuple[Address, tuple[Address, ...]]:
    """Read where the peer link listens and whom it sends to, all IPv4 addresses with port.

    Numeric only: in the air there is no name server to ask.

    Raises:
        ConfigError: an entry is no ``ADDRESS:PORT``; a multicast group is not
            alone, or its port is not the one listened at.
    """
    listen_address = _numeric(listen, "listen")
    if ipaddress.ip_address(listen_address[0]).is_multicast:
        raise ConfigError(
            f"listen: {listen_address[0]} is a multicast group, which goes into `to`; here goes "
            "the address of the interface to join it on"
        )
    if to and listen_address[1] == 0:
        raise ConfigError(f"listen: {listen} needs a port above 0, which the others send to")
    destinations = tuple(_numeric(text, "to") for text in to)
    if len(destinations) > _MAX_PEERS:
        raise ConfigError(f"to: at most {_MAX_PEERS} addresses, got {len(destinations)}")
    for text, there in zip(to, destinations, strict=True):
        if destinations.count(there) > 1:
            raise ConfigError(f"to: {text} is there twice")
    for host, port in destinations:
        if port == 0:
            raise ConfigError(f"to: {host} needs a port above 0")
        alone = len(destinations) == 1 and port == listen_address[1]
        if ipaddress.ip_address(host).is_multicast and not alone:
            raise ConfigError(f"to: a multicast group ({host}) stands alone, with listen's port")
    return listen_address, destinations


def open_peer_socket(
    listen: str, to: Sequence[str], tally: LinkTally, backoff: Backoff | None = None
) -> PeerSocket:
    """Return the swarm's transport; raise ConfigError as ``parse_peers`` does."""
    listen_address, destinations = parse_peers(listen, to)
    return PeerSocket(
        listen_address, destinations, PEER_RECEIVE_BUFFER_BYTES, tally, backoff or Backoff()
    )


def _numeric(text: str, what: str) -> Address:
    host, _, port = text.rpartition(":")
    try:
        address = str(ipaddress.IPv4Address(host))
    except ValueError as error:
        raise ConfigError(f"{what}: expected a numeric IPv4 ADDRESS:PORT, got {text!r}") from error
    return address, _bounded_int(port, 65535, "port", what)


def _split_host_port(text: str, what: str) -> Address:
    host, _, port = text.rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        raise ConfigError(f"{what}: an IPv6 address stands in brackets, like [::1]:14550")
    if not host:
        raise ConfigError(f"{what}: expected HOST:PORT, got {text!r}")
    return host, _bounded_int(port, 65535, "port", what)


def _bounded_int(text: str, largest: int, name: str, what: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 9 and int(text) <= largest):
        raise ConfigError(f"{what}: {name} must be a number up to {largest}, got {text!r}")
    return int(text)
