"""`vcl keys`: from a new key to a daemon that takes it, and every way to get it wrong."""

import errno
import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from vcl_companion.cli import main


def vcl(*arguments: str | Path) -> tuple[int, str]:
    """Run `vcl keys ...`; return its exit status and all that it said."""
    result = CliRunner().invoke(main, ["keys", *map(str, arguments)])
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.exit_code, result.output


def fingerprint(said: str) -> str:
    found = re.search(r": key ([0-9a-f]{16})\n", said)
    assert found is not None, said
    return found[1]


@pytest.fixture
def key(tmp_path: Path) -> Path:
    path = tmp_path / "swarm.key"
    assert vcl("new", path)[0] == 0
    return path


def drone_config(folder: Path, key_file: Path | str) -> Path:
    path = folder / "drone.toml"
    path.write_text(
        f"[swarm]\nmembers = [1, 2]\n[peers]\nto = ['127.0.0.1:9']\nkey_file = '{key_file}'\n"
    )
    path.chmod(0o640)
    return path


def test_a_key_is_made_shown_and_installed(tmp_path: Path, key: Path) -> None:
    assert key.stat().st_mode & 0o777 == 0o600
    secret = key.read_text().strip()
    status, shown = vcl("show", key)
    assert status == 0
    assert secret not in shown
    config = drone_config(tmp_path, tmp_path / "installed.key")
    status, said = vcl("install", key, "--config", config)
    assert (status, secret in said) == (0, False)
    assert fingerprint(said) == fingerprint(shown)
    installed = tmp_path / "installed.key"
    assert installed.read_text() == key.read_text()
    assert installed.stat().st_mode & 0o777 == 0o640
    # Another key takes its place.
    vcl("new", tmp_path / "next.key")
    status, said = vcl("install", tmp_path / "next.key", "--config", config)
    assert status == 0
    assert fingerprint(vcl("show", installed)[1]) == fingerprint(said) != fingerprint(shown)


def test_a_key_that_went_through_an_editor_with_byte_order_marks_is_read(
    tmp_path: Path, key: Path
) -> None:
    marked = tmp_path / "marked.key"
    marked.write_bytes(b"\xef\xbb\xbf" + key.read_bytes())
    marked.chmod(0o600)
    assert fingerprint(vcl("show", marked)[1]) == fingerprint(vcl("show", key)[1])


def test_the_secret_is_shown_on_request_as_ground_stations_take_it(key: Path) -> None:
    status, shown = vcl("show", "--secret", key)
    passphrase = re.search(r"\npassphrase: ([0-9a-f]{64})\n", shown)
    assert status == 0
    assert passphrase is not None
    # QGroundControl and MAVProxy sign with the SHA-256 of what they are told.
    secret = hashlib.sha256(passphrase[1].encode()).digest()
    expected = hashlib.sha256(b"vcl key fingerprint\0" + secret).hexdigest()[:16]
    assert fingerprint(shown) == expected


def test_a_full_disk_leaves_no_half_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would be taken for one that is there already."""

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "k.key"
    with monkeypatch.context() as disk:
        disk.setattr(os, "fsync", full)
        assert_one_line(vcl("new", path), "k.key: No space left on device")
    assert list(tmp_path.iterdir()) == []
    assert vcl("new", path)[0] == 0


def test_a_key_goes_to_a_folder_under_its_own_name(tmp_path: Path, key: Path) -> None:
    folder = tmp_path / "image" / "etc"
    folder.mkdir(parents=True)
    status, said = vcl("install", key, "--to", folder)
    assert status == 0
    assert fingerprint(said) == fingerprint(vcl("show", folder / "swarm.key")[1])
    assert (folder / "swarm.key").stat().st_mode & 0o777 == 0o600


def assert_one_line(said: tuple[int, str], *texts: str) -> None:
    status, line = said
    assert status == 2
    assert line.startswith("vcl: ")
    assert line.count("\n") == 1
    for text in texts:
        assert text in line


def test_mistakes_are_one_line_and_status_2(tmp_path: Path, key: Path) -> None:
    before = key.read_text()
    assert_one_line(vcl("new", key), "is there already")
    assert key.read_text() == before
    no_folder = f"there is no folder {tmp_path / 'nowhere'}; make it first"
    assert_one_line(vcl("new", tmp_path / "nowhere" / "key"), no_folder)
    assert_one_line(vcl("show", tmp_path / "none"), "none: No such file")
    assert_one_line(vcl("show", tmp_path), "Is a directory")
    (tmp_path / "text").write_text("my secret")
    (tmp_path / "text").chmod(0o600)
    said = vcl("show", tmp_path / "text")
    assert_one_line(said, "is no key file", "vcl keys new")
    assert "my secret" not in said[1]
    assert_one_line(vcl("install", key), "either --config or --to")
    config = drone_config(tmp_path, tmp_path / "k")
    both = vcl("install", key, "--config", config, "--to", tmp_path)
    assert_one_line(both, "either --config or --to")
    assert_one_line(vcl("install", tmp_path / "text", "--config", config), "is no key file")
    assert not (tmp_path / "k").exists()
    assert_one_line(vcl("install", key, "--to", tmp_path / "nowhere"), "cannot be installed")
    assert_one_line(vcl("install", key, "--config", tmp_path / "none.toml"), "none.toml")
    config = drone_config(tmp_path, "")
    assert_one_line(vcl("install", key, "--config", config), "[peers] key_file", "vcl keys new")
    config.write_text("")
    assert_one_line(vcl("install", key, "--config", config), "[peers] key_file: is not set")
    # What is no key is not replaced by one, whatever the configuration says.
    config = drone_config(tmp_path, tmp_path / "text")
    assert_one_line(vcl("install", key, "--config", config), "is there, and is no key file")
    assert (tmp_path / "text").read_text() == "my secret"
    config = drone_config(tmp_path, "/dev/null")
    assert_one_line(vcl("install", key, "--config", config), "is there, and is no key file")
    key.chmod(0o644)
    assert_one_line(vcl("show", key), "others can read", "chmod 600")
    assert_one_line(vcl("show", "--secret", key), "others can read", "chmod 600")


@pytest.mark.parametrize("mode", [None, 0o644])
def test_a_daemon_does_not_start_without_its_key(tmp_path: Path, mode: int | None) -> None:
    key = tmp_path / "swarm.key"
    if mode is not None:
        vcl("new", key)
        key.chmod(mode)
    sensor = Path(__file__).parents[1] / "sitl/recordings/demo/mav0/cam0/sensor.yaml"
    config = tmp_path / "drone.toml"
    config.write_text(
        f"[camera]\ncalibration = '{sensor}'\n[swarm]\nmembers = [1, 2]\n"
        f"[peers]\nto = ['127.0.0.1:9']\nkey_file = '{key}'\n"
    )
    result = subprocess.run(
        [sys.executable, "-m", "vcl_companion", "run", "--config", str(config)],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={"PYTHONPATH": str(Path(__file__).parents[1])},
    )
    why = "No such file" if mode is None else "others can read"
    assert_one_line((result.returncode, result.stderr), str(key), why)


def test_looking_at_a_key_loads_nothing_heavy() -> None:
    code = (
        "import sys, vcl_companion.cli as c; c.main(['keys', 'show', '/none'], standalone_mode=0);"
        "sys.exit(any(m in sys.modules for m in ('cv2', 'numpy', 'pymavlink')))"
    )
    result = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True)
    assert (result.returncode, result.stderr[:5]) == (0, b"vcl: ")
