"""The rendered scenarios, kept: each is rendered once, and anew when it or the renderer changed.

``FOLDER/NAME`` is the recording, ``FOLDER/NAME.rendered.json`` says from what it
was made. The recording gets its name at once when it is complete; what a run
that was killed left unfinished is removed, and begun again.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sitl import paper_fingerprint
from sitl.paper_fingerprint import Fingerprint
from sitl.render import render_scenario
from sitl.scenario import Scenario
from vcl_companion.errors import ConfigError

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Rendered:
    """A recording on disk.

    Attributes:
        path: its folder.
        fingerprint: what it was made from.
        reused: whether it was there already.
        why: why it was not reused; empty when there was none.
    """

    path: Path
    fingerprint: Fingerprint
    reused: bool
    why: str = ""


def rendered(scenario: Scenario, label: str, folder: Path, progress: Progress) -> Rendered:
    """Return a scenario's recording, rendered unless it is there.

    Args:
        scenario: what to render.
        label: name of the recording in the folder.
        folder: where recordings are kept; made when absent.
        progress: told after every frame that is rendered.

    Raises:
        ConfigError: the folder cannot be written, or holds a recording of this
            name that was not made here.
    """
    path, mark = folder / label, folder / f"{label}.rendered.json"
    now = paper_fingerprint.of_recording(scenario)
    before = paper_fingerprint.written(mark)
    if path.is_dir() and before == now:
        return Rendered(path, now, reused=True)
    if path.exists() and before is None:
        raise ConfigError(
            f"{path}: what it was made of is not known (no {mark.name} beside it); "
            "move it away or give another folder"
        )
    why = ""
    if before is not None and path.exists():
        why = f"{' and '.join(paper_fingerprint.differences(before, now))} changed"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        stale = folder / f".{label}.stale"
        for left in (stale, *folder.glob(f".{label}.*.partial")):
            if left.exists():
                shutil.rmtree(left)
        if path.exists():
            path.rename(stale)
            shutil.rmtree(stale)
        # Before the recording, which alone says that it is there: never one without its mark.
        paper_fingerprint.write(mark, now)
        render_scenario(scenario, path, progress)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror})") from error
    return Rendered(path, now, reused=False, why=why)
