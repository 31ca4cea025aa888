import logging
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import pytest
from click.testing import CliRunner

from vcl_companion.cli import main
from vcl_companion.cli.journal import set_up_logging
from vcl_companion.config import LogOptions


@pytest.fixture
def root_logger() -> Iterator[logging.Logger]:
    """The root logger, put back as pytest had it."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield root
    root.handlers[:] = handlers
    root.setLevel(level)


def test_version_is_the_package_s() -> None:
    result = CliRunner().invoke(main, ["--version"])
    assert (result.exit_code, result.output) == (0, f"vcl, version {version('vcl-companion')}\n")


def test_a_broken_configuration_is_one_line_and_status_2(tmp_path: Path) -> None:
    file = tmp_path / "drone.toml"
    file.write_text("[camera]\nsorce = 'oak'\n")
    result = subprocess.run(
        [sys.executable, "-m", "vcl_companion", "run", "--config", str(file)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr == (
        f"vcl: {file}: camera.sorce: unknown key; the nearest valid key is camera.source\n"
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("arguments", [["--help"], ["keys", "new", "{folder}/k.key"]])
def test_a_full_standard_output_is_one_line(tmp_path: Path, arguments: list[str]) -> None:
    words = [word.format(folder=tmp_path) for word in arguments]
    with open("/dev/full", "w") as full:
        result = subprocess.run(
            [sys.executable, "-m", "vcl_companion", *words],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert result.returncode == 1
    assert result.stderr == "vcl: standard output: No space left on device\n"


def test_a_missing_configuration_names_the_file(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["run", "--config", str(tmp_path / "none.toml")])
    assert result.exit_code == 2
    assert "none.toml: No such file" in result.output


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("run", "vcl: Missing option '--config' (see main run --help)"),
        ("rum", "vcl: No such command 'rum'. Did you mean 'run'? (see main --help)"),
        ("--loud", "vcl: No such option '--loud' (see main --help)"),
        ("keys new", "vcl: Missing argument 'FILE' (see main keys new --help)"),
    ],
)
def test_a_command_that_is_wrong_is_one_line_and_status_2(arguments: str, line: str) -> None:
    result = CliRunner().invoke(main, arguments.split())
    assert (result.exit_code, result.stdout, result.stderr) == (2, "", f"{line}\n")


def test_a_group_without_a_command_is_its_help() -> None:
    result = CliRunner().invoke(main, ["keys"])
    assert result.exit_code == 2
    assert "install" in result.output
    assert "Make, install and look at the key" in result.output


def test_ctrl_c_is_one_line_and_status_130() -> None:
    # Who runs the tests in the background may have them ignore it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with socket.create_server(("127.0.0.1", 0)) as drone:
            drone.settimeout(60.0)
            order = ["ground", "resume", "--link", f"tcp:127.0.0.1:{drone.getsockname()[1]}"]
            with (
                subprocess.Popen(
                    [sys.executable, "-m", "vcl_companion", *order],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                ) as run,
                drone.accept()[0],
            ):  # the connection stays: one that ends is told of
                run.send_signal(signal.SIGINT)
                out, error = run.communicate(timeout=60.0)
    finally:
        signal.signal(signal.SIGINT, before)
    assert (run.returncode, out, error) == (130, "", "vcl: interrupted\n")


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys, vcl_companion.cli as c; c.main(['--help'], standalone_mode=False);"
        "sys.exit(any(m in sys.modules for m in ('cv2', 'numpy', 'pymavlink')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_messages_below_the_level_are_dropped(
    root_logger: logging.Logger,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("JOURNAL_STREAM", raising=False)
    set_up_logging(LogOptions(level="warning"))
    logging.getLogger("a.b").info("no")
    logging.getLogger("a.b").warning("yes")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].endswith("WARNING a.b: yes")


def test_under_journald_every_line_has_its_severity(
    root_logger: logging.Logger,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("JOURNAL_STREAM", "8:1")
    set_up_logging(LogOptions())
    logging.getLogger("a").error("one\ntwo")
    assert capsys.readouterr().err == "<3>a: one\n<3>two\n"
