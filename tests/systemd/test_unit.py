import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

SYSTEMD = Path(__file__).parents[2] / "systemd"
UNIT = SYSTEMD / "vcl-companion@.service"
PROGRAM = "/opt/vcl-companion/bin/vcl"
# Known to systemd from 254 on; the unit says what older ones do.
NEWER_KEYS = ("RestartSteps", "RestartMaxDelaySec")


def tool(name: str) -> str:
    """Return the path of a program of Debian's package systemd."""
    found = shutil.which(name)
    if found is None:
        if os.environ.get("CI") == "true":
            pytest.fail(f"{name} is not there: .ci/run installs the package systemd")
        pytest.skip(f"{name} is not there: install the package systemd")
    return found


def verify(text: str, folder: Path) -> tuple[int, str]:
    """Return the status and the complaints of ``systemd-analyze verify`` about a unit's text."""
    analyze = tool("systemd-analyze")
    banner = subprocess.run([analyze, "--version"], capture_output=True, text=True, check=True)
    version = re.match(r"systemd (\d+)", banner.stdout)
    assert version is not None
    if int(version[1]) < 254:
        text = re.sub(rf"^({'|'.join(NEWER_KEYS)})=.*\n", "", text, flags=re.MULTILINE)
    unit = folder / UNIT.name
    # The program must exist for verify; where it will be installed is not this machine's matter.
    unit.write_text(text.replace(PROGRAM, shutil.which("true") or "/bin/true"))
    command = [analyze, "verify", "--man=no", "--recursive-errors=no", str(unit)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    return result.returncode, result.stderr


def test_systemd_accepts_the_unit(tmp_path: Path) -> None:
    assert verify(UNIT.read_text(), tmp_path) == (0, "")


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("WatchdogSec=10s", "WatchdogSec=soon"),
        ("ProtectHome=yes", "ProtectHouse=yes"),
        (f"ExecStart={PROGRAM}", "ExecStart=/nowhere/vcl"),
    ],
)
def test_the_check_finds_a_broken_unit(tmp_path: Path, before: str, after: str) -> None:
    text = UNIT.read_text()
    assert before in text
    status, complaints = verify(text.replace(before, after), tmp_path)
    assert status != 0
    assert complaints


def test_the_unit_is_what_the_daemon_expects() -> None:
    said = dict(
        line.split("=", 1) for line in UNIT.read_text().splitlines() if re.match(r"[A-Z]\w*=", line)
    )
    assert said["ExecStart"] == f"{PROGRAM} run --config /etc/vcl-companion/%i.toml"
    expected = {"Type": "notify", "User": "vcl", "Restart": "on-failure", "WatchdogSec": "10s"}
    assert expected.items() <= said.items()
    # Without a home, numba keeps what it compiles only where it is told to.
    assert f"NUMBA_CACHE_DIR=%C/{said['CacheDirectory']}/" in said["Environment"]


def test_sysusers_makes_the_user(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    file = SYSTEMD / "vcl-companion.sysusers"
    subprocess.run([tool("systemd-sysusers"), f"--root={tmp_path}", str(file)], check=True)
    users = (tmp_path / "etc/passwd").read_text()
    assert re.search(r"^vcl:.*:/var/lib/vcl-companion:.*nologin$", users, re.MULTILINE)
    groups = [line.split(":") for line in (tmp_path / "etc/group").read_text().splitlines()]
    members = {name: users for name, _, _, users in groups}
    assert members["dialout"] == members["video"] == "vcl"


def test_udev_rules_are_well_formed() -> None:
    assignment = r'[A-Z]+(\{\w+\})?(==|!=|\+=|-=|:=|=)"[^"]*"'
    rules = [
        line
        for line in (SYSTEMD / "60-vcl-companion.rules").read_text().splitlines()
        if line and not line.startswith("#")
    ]
    for rule in rules:
        assert re.fullmatch(rf"{assignment}(, {assignment})*", rule), rule
    text = "\n".join(rules)
    assert set(re.findall(r'GOTO="(\w+)"', text)) == set(re.findall(r'LABEL="(\w+)"', text))
