"""What went between the drones of a flight and what became of it, kept beside the daemons' logs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec

from sitl.network import Fate
from sitl.peer_traffic import Traffic
from sitl.processes import FlightError
from sitl.relay import Relay

_FILE = Path("run") / "network.json"


@dataclass(frozen=True)
class NetworkLog:
    """A relay's counts.

    Attributes:
        sent: drone to name of a message to how much of it.
        fates: sender to receiver to what became of its datagrams.
        n_dropped: datagrams that this machine, not the network, did not get across.
        n_strangers: datagrams of somebody else.
    """

    sent: dict[str, dict[str, Traffic]]
    fates: dict[str, dict[str, Fate]]
    n_dropped: int
    n_strangers: int


def write_network_log(out: Path, relay: Relay) -> None:
    """Write what a relay has counted into a flight's folder."""
    fates: dict[str, dict[str, Fate]] = {}
    for (sender, receiver), fate in relay.network.fates.items():
        fates.setdefault(sender, {})[receiver] = fate
    log = NetworkLog(relay.traffic.sent, fates, relay.n_dropped, relay.n_strangers)
    text = msgspec.json.format(msgspec.json.encode(log), indent=1)
    (out / _FILE).write_bytes(text + b"\n")


def read_network_log(out: Path) -> NetworkLog | None:
    """Read what was written; None when there is nothing.

    Raises:
        FlightError: it is not what it should be; names the file.
    """
    path = out / _FILE
    try:
        return msgspec.json.decode(path.read_bytes(), type=NetworkLog)
    except FileNotFoundError:
        return None
    except (OSError, msgspec.MsgspecError) as error:
        raise FlightError(f"{path}: {error}") from error
