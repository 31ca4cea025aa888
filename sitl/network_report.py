"""The report's part about the radio: what each drone sent, by message, and what became of it.

Of each drone, as ``peer_link`` (None when nothing was counted):

* ``by_message``: name to ``messages``, ``payload_bytes`` (of TUNNEL, without padding),
  ``wire_bytes`` (the whole MAVLink frames), ``wire_bytes_per_s`` of recording time. What
  all hear counts once, where it is sent to each by itself once for each.
* the same sums over all messages.
* ``network``: what became of it: ``offered`` datagrams are those ``lost``, ``queue_full``
  (dropped before a transmission that would have waited too long), ``cut`` (by a
  partition) and ``delivered`` less ``duplicated``; ``corrupted`` and ``held_back`` of the
  delivered ones; ``delay_mean_ms`` and ``delay_max_ms`` of those, as the network meant it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from sitl.network import Fate, NetworkOptions
from sitl.network_log import NetworkLog
from sitl.page_style import table
from sitl.peer_traffic import Traffic

NETWORK_COLUMNS = (
    ("offered", "sent"),
    ("delivered", "arrived"),
    ("lost", "lost"),
    ("queue_full", "queue full"),
    ("cut", "cut off"),
    ("corrupted", "wrong bytes"),
    ("duplicated", "twice"),
    ("held_back", "held back"),
)
DELAYS = ("delay_mean_ms", "delay_max_ms")
_NOTHING = {"messages": 0, "payload_bytes": 0, "wire_bytes": 0, "wire_bytes_per_s": 0.0}


def peer_link_of(log: NetworkLog | None, drone: str, duration_s: float) -> dict[str, Any] | None:
    """Return a drone's ``peer_link`` of ``report.json``.

    Args:
        log: what the relay counted; None when it did not.
        drone: its name.
        duration_s: of the recording that was flown.
    """
    if log is None:
        return None
    sent = log.sent.get(drone, {})
    names = sorted(sent, key=lambda name: (-sent[name].wire_bytes, name))
    return {
        **_amount(sent.values(), duration_s),
        "by_message": {name: _amount([sent[name]], duration_s) for name in names},
        "network": _fate(log.fates.get(drone, {}).values()),
    }


def options_of(options: NetworkOptions) -> dict[str, Any]:
    """Return a network's options as JSON knows them."""
    return {**asdict(options), "partitions": [str(p) for p in options.partitions]}


def network_text(options: Mapping[str, Any]) -> str:
    """Return what is said of the network that was flown over, given ``options_of``."""
    usual = options_of(NetworkOptions())
    said = {k: v for k, v in options.items() if v != usual[k]}
    texts = (f"{k} {' '.join(v) if k == 'partitions' else v}" for k, v in said.items())
    return ", ".join(texts) or "perfect"


@dataclass(frozen=True)
class MessageRow:
    """One line of the table of bytes.

    Attributes:
        name: of the message.
        messages, payload_bytes, wire_bytes: of all drones.
        share: of all bytes on the wire.
        wire_bytes_per_s: of all drones.
        by_drone: bytes on the wire, in the drones' order.
    """

    name: str
    messages: int
    payload_bytes: int
    wire_bytes: int
    share: float
    wire_bytes_per_s: float
    by_drone: tuple[int, ...]


def message_rows(report: Mapping[str, Any]) -> list[MessageRow]:
    """Return the table of bytes, the most first, its last row the sums; empty without counts."""
    links = [drone.get("peer_link") for drone in report["drones"].values()]
    if not links or not all(links):
        return []
    names = {name for link in links for name in link["by_message"]}
    whole = sum(link["wire_bytes"] for link in links)
    rows = [
        _row(name, [link["by_message"].get(name, _NOTHING) for link in links], whole)
        for name in names
    ]
    rows.sort(key=lambda row: (-row.wire_bytes, row.name))
    return [*rows, _row("all", links, whole)]


def network_html(report: Mapping[str, Any]) -> str:
    """Return the tables of bytes and of what became of them; empty without counts."""
    rows = message_rows(report)
    if not rows:
        return ""
    drones = report["drones"]
    heads = ["message", "messages", "payload kB", "on the wire kB", "%", "B/s", *drones]
    by_message = [
        (row.name, f"{row.messages}", f"{row.payload_bytes / 1e3:.1f}",
         f"{row.wire_bytes / 1e3:.1f}", f"{100.0 * row.share:.1f}",
         f"{row.wire_bytes_per_s:.0f}", *(f"{n / 1e3:.1f}" for n in row.by_drone))
        for row in rows
    ]  # fmt: skip
    fates = [
        (name, *(str(drone["peer_link"]["network"][key]) for key, _ in NETWORK_COLUMNS),
         *(delay_text(drone["peer_link"]["network"][key]) for key in DELAYS))
        for name, drone in drones.items()
    ]  # fmt: skip
    fate_heads = ["drone", *(label for _, label in NETWORK_COLUMNS), "delay ms", "longest ms"]
    return table(heads, by_message) + table(fate_heads, fates)


def delay_text(delay_ms: float | None) -> str:
    """Return a delay for people."""
    return "-" if delay_ms is None else f"{delay_ms:.1f}"


def _amount(traffic: Iterable[Traffic], duration_s: float) -> dict[str, Any]:
    parts = list(traffic)
    wire_bytes = sum(part.wire_bytes for part in parts)
    return {
        "messages": sum(part.messages for part in parts),
        "payload_bytes": sum(part.payload_bytes for part in parts),
        "wire_bytes": wire_bytes,
        "wire_bytes_per_s": wire_bytes / duration_s if duration_s > 0.0 else None,
    }


def _fate(fates: Iterable[Fate]) -> dict[str, Any]:
    of_links = list(fates)
    delivered = sum(fate.delivered for fate in of_links)
    mean_s = sum(fate.delay_sum_s for fate in of_links) / delivered if delivered else None
    longest_s = max(fate.delay_max_s for fate in of_links) if delivered else None
    return {
        **{key: sum(getattr(fate, key) for fate in of_links) for key, _ in NETWORK_COLUMNS},
        "delay_mean_ms": None if mean_s is None else 1e3 * mean_s,
        "delay_max_ms": None if longest_s is None else 1e3 * longest_s,
    }


def _row(name: str, of_drones: list[Mapping[str, Any]], whole: int) -> MessageRow:
    wire_bytes = sum(said["wire_bytes"] for said in of_drones)
    return MessageRow(
        name=name,
        messages=sum(said["messages"] for said in of_drones),
        payload_bytes=sum(said["payload_bytes"] for said in of_drones),
        wire_bytes=wire_bytes,
        share=wire_bytes / whole if whole else 0.0,
        wire_bytes_per_s=sum(said["wire_bytes_per_s"] or 0.0 for said in of_drones),
        by_drone=tuple(said["wire_bytes"] for said in of_drones),
    )
