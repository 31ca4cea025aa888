"""Folders that measurements leave their results in."""

from pathlib import Path

import pytest

from sitl.result_folder import result_folder
from vcl_companion.errors import ConfigError


def test_results_go_where_nothing_else_is(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    for _ in range(2):
        with result_folder(out, ("scale.*",)):
            (out / "scale.md").write_text("x")
    (out / "thesis.tex").touch()
    with (
        pytest.raises(ConfigError, match=r"b: holds something else, thesis.tex; give another"),
        result_folder(out, ("scale.*",)),
    ):
        (out / "scale.md").unlink()
    assert (out / "scale.md").read_text() == "x"


def test_what_is_no_folder_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path, says in (
        (tmp_path / "file", "is a file"),
        (tmp_path / "file" / "x", "cannot be written"),
    ):
        with pytest.raises(ConfigError, match=says), result_folder(path, ()):
            pass


def test_a_disk_that_is_full_while_results_are_written_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No space left"), result_folder(tmp_path, ()):
        raise OSError(28, "No space left on device")
