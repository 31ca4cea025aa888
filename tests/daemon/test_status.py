"""What a service says of itself in a file, and ``vcl status`` of it."""

import json
import time
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from vcl_companion.cli import main
from vcl_companion.daemon.status import (
    AutopilotStatus,
    MapStatus,
    ServiceStatus,
    read_status,
    status_lines,
    write_status,
)
from vcl_companion.errors import ConfigError

FUSED = AutopilotStatus("ardupilot", "fused", "", 24.0, 1.5)


def good() -> ServiceStatus:
    return ServiceStatus(
        7, time.time(), "active", "localized", 0.02, FUSED, MapStatus("c70ee5cf", 986, 3), (1, 7), 1
    )


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "status.json"
    said = good()
    write_status(path, said)
    assert read_status(path) == said
    assert said.is_good
    write_status(path, replace(said, map=None, sigma_m=None))
    assert read_status(path).map is None
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "changed",
    [
        {"state": "critical"},
        {"written_at_s": 1.0},
        {"written_at_s": time.time() + 3600.0},
        {"autopilot": replace(FUSED, fusion="rejected", reason="its estimator has no position")},
    ],
)
def test_what_is_not_good_is_said(changed: dict[str, object]) -> None:
    assert not replace(good(), **changed).is_good  # type: ignore[arg-type]


def test_people_are_told_what_to_do() -> None:
    text = "\n".join(status_lines(good()))
    assert "our poses fused" in text
    assert "VISO_DELAY_MS should be 24 ms less" in text
    assert "986 landmarks in 3 keyframes" in text
    text = status_lines(replace(good(), written_at_s=time.time() + 3600.0))[0]
    assert "3600 s from now, by a clock that was set back since" in text
    late = replace(good(), autopilot=replace(FUSED, firmware="px4", ahead_ms=-40.0), map=None)
    text = "\n".join(status_lines(late))
    assert "EKF2_EV_DELAY should be 40 ms more" in text
    assert "map        none" in text
    right = replace(good(), autopilot=replace(FUSED, ahead_ms=2.0))
    assert "right to 5 ms" in "\n".join(status_lines(right))
    assert "not heard of for" in status_lines(replace(good(), written_at_s=1.0))[0]


@pytest.mark.parametrize(
    "data", [b"", b"{", b"[]", b'{"system_id": 1}', b"\xff" * 99, b'{"a": "\xff"}']
)
def test_something_else_is_refused_in_one_line(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "status.json"
    path.write_bytes(data)
    with pytest.raises(ConfigError, match=r"status\.json: is no status") as raised:
        read_status(path)
    assert "\n" not in str(raised.value)


def test_the_command_says_it_and_ends_with_whether_it_is_good(tmp_path: Path) -> None:
    config, path = tmp_path / "one.toml", tmp_path / "status.json"
    config.write_text(f'[log]\nstatus_file = "{path}"\n')
    runner = CliRunner()

    def status(*more: str) -> tuple[int, str]:
        result = runner.invoke(main, ["status", "--config", str(config), *more])
        return result.exit_code, result.output

    code, text = status()
    assert code == 2
    assert "is the service running?" in text
    write_status(path, good())
    code, text = status()
    assert code == 0
    assert "our poses fused" in text
    code, text = status("--json")
    assert code == 0
    assert json.loads(text)["autopilot"]["fusion"] == "fused"
    write_status(path, replace(good(), autopilot=replace(FUSED, fusion="rejected")))
    assert status()[0] == 1
    config.write_text("")
    code, text = status()
    assert code == 2
    assert "status_file" in text
