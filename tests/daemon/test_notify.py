import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from vcl_companion.daemon import notify


@pytest.fixture(params=["path", "abstract"])
def manager(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[socket.socket]:
    """A service manager that listens, as a real datagram socket."""
    path = str(tmp_path / "notify")
    address, name = (path, path) if request.param == "path" else (f"\0{path}", f"@{path}")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(address)
        listening.settimeout(5.0)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        yield listening


def test_each_call_is_one_datagram(manager: socket.socket) -> None:
    notify.ready()
    notify.watchdog()
    notify.status("localizing,\n12 Hz é")
    notify.stopping()
    assert [manager.recv(200).decode() for _ in range(4)] == [
        "READY=1",
        "WATCHDOG=1",
        "STATUS=localizing, 12 Hz é",
        "STOPPING=1",
    ]


def test_a_full_queue_does_not_block(manager: socket.socket) -> None:
    for _ in range(2000):  # far beyond net.unix.max_dgram_qlen
        notify.watchdog()
    assert manager.recv(200) == b"WATCHDOG=1"


@pytest.mark.parametrize("address", [None, "", "relative", "/nowhere/at/all"])
def test_without_a_manager_nothing_happens(
    address: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    if address is not None:
        monkeypatch.setenv("NOTIFY_SOCKET", address)
    notify.ready()
    notify.status("x")
