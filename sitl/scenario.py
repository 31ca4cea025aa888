"""A flight as a text: what stands in the world, what the cameras are like, who flies where.

``sitl/scenarios/*.toml`` are known by their names; any other file by its path. A
file that says ``based_on = "another"`` is that scenario with some of its top-level
keys replaced. What its numbers may be is in ``scenario_ranges``.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, get_args, get_type_hints

import msgspec
import numpy as np

from sitl.mission import Mission
from sitl.renderer import Imaging
from sitl.scenario_ranges import out_of_range
from sitl.town import Town
from sitl.trajectories import Flight, FlightPath
from vcl_companion.cameras.mounting import mounted_rotation
from vcl_companion.errors import ConfigError
from vcl_companion.geometry.camera import Camera, DistortionModel
from vcl_companion.geometry.pose import Pose
from vcl_companion.recording import Sensor
from vcl_companion.text_file import read_text

SCENARIOS = Path(__file__).resolve().parent / "scenarios"

_MOST_SAMPLES = 2**26  # of one image: 1 GiB and more while it is rendered

Triple = tuple[float, float, float]


class Lens(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The camera of all drones: intrinsics and where it sits.

    Attributes:
        width_px, height_px: image size.
        focal_px: focal length.
        cx_px, cy_px: principal point; the image's centre when not given.
        distortion_model, distortion: see ``Camera``.
        position_m: of the camera in the body, FRD.
        roll_pitch_yaw_deg: of the camera against looking straight ahead.
    """

    width_px: int = 640
    height_px: int = 480
    focal_px: float = 360.0
    cx_px: float | None = None
    cy_px: float | None = None
    distortion_model: DistortionModel = "none"
    distortion: tuple[float, ...] = ()
    position_m: Triple = (0.0, 0.0, 0.0)
    roll_pitch_yaw_deg: Triple = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        camera = self.camera()
        # Half a pixel outwards: what is rendered of a pixel is its area.
        right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
        corners = np.array([[-0.5, -0.5], [right, -0.5], [-0.5, bottom], [right, bottom]])
        if not np.isfinite(camera.ideal_from_pixels(corners)).all():
            raise ValueError(
                "camera: its corners look 90 degrees or more aside, or the distortion folds "
                "before them; a longer focal_px or a smaller image is needed"
            )

    def camera(self) -> Camera:
        """Return the intrinsics."""
        cx = (self.width_px - 1) / 2 if self.cx_px is None else self.cx_px
        cy = (self.height_px - 1) / 2 if self.cy_px is None else self.cy_px
        return Camera(
            self.width_px,
            self.height_px,
            self.focal_px,
            self.focal_px,
            cx,
            cy,
            self.distortion_model,
            self.distortion,
        )

    def body_from_cam(self, tilt_deg: float = 0.0) -> Pose:
        """Return where the camera sits, looking higher by a tilt."""
        roll, pitch, yaw = self.roll_pitch_yaw_deg
        return Pose(mounted_rotation((roll, pitch + tilt_deg, yaw)), np.array(self.position_m))


class Picture(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How images are taken (see ``Imaging``) and kept."""

    supersampling: int = 2
    blur_px: float = 0.5
    noise_levels: float = 2.0
    gain: float = 1.0
    vignetting: float = 0.0
    format: Literal["jpg", "png"] = "jpg"
    jpg_quality: int = 90

    def __post_init__(self) -> None:
        self.imaging(1.0)

    def imaging(self, drone_gain: float) -> Imaging:
        """Return the options of one drone's renderer."""
        gain = self.gain * drone_gain
        return Imaging(self.supersampling, self.blur_px, self.noise_levels, gain, self.vignetting)


class DroneInScenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One drone.

    Attributes:
        name: mav0, mav1, ...
        flight: its path, in a scenario to be rendered.
        mission: what it is to do, in one to be flown live; one of the two.
        gain: its camera's exposure against the others'.
        delay_s: how much later than the scenario's instants it takes its frames.
        tilt_deg: its camera looks so much higher than the others', lower when negative.
    """

    name: str
    flight: Flight | None = None
    mission: Mission | None = None
    gain: float = 1.0
    delay_s: float = 0.0
    tilt_deg: float = 0.0

    def __post_init__(self) -> None:
        if not re.fullmatch(r"mav[0-9]{1,6}", self.name):
            raise ValueError(f"drone: names are mav0, mav1, ...; got {self.name!r}")
        if (self.flight is None) == (self.mission is None):
            raise ValueError(f"drone {self.name}: it has either a flight or a mission")

    def path(self) -> FlightPath:
        """Return how it moves.

        Raises:
            ConfigError: nobody knows before it has flown.
        """
        if self.flight is None:
            raise ConfigError(f"{self.name} has a mission: fly it by python -m sitl live")
        return FlightPath(self.flight)


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One flight of N drones.

    Attributes:
        name: for people.
        drone: who flies.
        world: what stands there.
        camera: of all drones.
        image: how images are taken and kept.
        leader: name of a drone.
        known_distance: names of two drones.
        frame_rate_hz, duration_s: frames are taken at 0, 1/rate, ... before duration.
        truth_rate_hz: rows of ground truth between the frames; 0 has none but at frames.
        start_at_ns: recording time of the first frame.
        seed: of the sensor noise; the world has its own.
    """

    name: str
    drone: tuple[DroneInScenario, ...]
    world: Town = Town()
    camera: Lens = Lens()
    image: Picture = Picture()
    leader: str = "mav0"
    known_distance: tuple[str, str] | None = None
    frame_rate_hz: float = 5.0
    duration_s: float = 12.0
    truth_rate_hz: float = 20.0
    start_at_ns: int = 1_000_000_000_000
    seed: int = 1

    def __post_init__(self) -> None:
        names = [drone.name for drone in self.drone]
        if not names or len(set(names)) != len(names):
            raise ValueError("scenario: one or more drones with different names")
        for name in (self.leader, *(self.known_distance or ())):
            if name not in names:
                raise ValueError(f"scenario: there is no drone {name!r}")
        samples = self.camera.width_px * self.camera.height_px * self.image.supersampling**2
        if samples > _MOST_SAMPLES:
            raise ValueError(
                f"scenario: width_px x height_px x supersampling^2 is at most {_MOST_SAMPLES}; "
                f"got {samples}"
            )

    @property
    def n_frames(self) -> int:
        """Frames of each drone."""
        return max(1, int(np.ceil(self.duration_s * self.frame_rate_hz - 1e-9)))

    def frame_at_ns(self, drone: DroneInScenario, k: int) -> int:
        """Return the instant of a drone's frame ``k``, recording time, ns."""
        after_s = k / self.frame_rate_hz + drone.delay_s
        return self.start_at_ns + round(after_s * 1e9)

    def flight_s(self, at_ns: int) -> float:
        """Return an instant of recording time as the flight's own time, s."""
        return (at_ns - self.start_at_ns) * 1e-9

    def sensor(self, drone: DroneInScenario) -> Sensor:
        """Return what a drone's ``sensor.yaml`` will say."""
        mounting = self.camera.body_from_cam(drone.tilt_deg)
        return Sensor(self.camera.camera(), mounting, self.frame_rate_hz, "NED")


def scenario_names() -> list[str]:
    """Return the names of the scenarios that come with the harness."""
    return sorted(path.stem for path in SCENARIOS.glob("*.toml"))


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Read a scenario by its name, or from a file that ends in ``.toml``.

    Raises:
        ConfigError: there is none of that name, or the file is not a scenario;
            one line that names the key.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = SCENARIOS / f"{name_or_path}.toml"
        if str(name_or_path) not in scenario_names():
            known = ", ".join(scenario_names())
            raise ConfigError(f"no scenario {str(name_or_path)!r}; there are: {known}")
    table = _table(path)
    while (base := table.pop("based_on", None)) is not None:
        if base not in scenario_names():
            known = ", ".join(scenario_names())
            raise ConfigError(f"{path}: based_on is one of {known}; got {base!r}")
        table = {**_table(SCENARIOS / f"{base}.toml"), **table}
    _refuse_unknown(table, Scenario, path, "")
    if wrong := out_of_range(table):
        raise ConfigError(f"{path}: {wrong}")
    try:
        return msgspec.convert(table, Scenario)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {error}") from None


def _table(path: Path) -> dict[str, Any]:
    """Return what a file says, or raise ConfigError in one line."""
    try:
        return tomllib.loads(read_text(path))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not TOML ({' '.join(str(error).split())})") from None


def _refuse_unknown(value: object, kind: Any, path: Path, where: str) -> None:
    """Raise ConfigError at the first key that its table cannot have, naming the nearest one."""
    if isinstance(kind, UnionType):  # one that may be absent
        kind = next(k for k in get_args(kind) if k is not NoneType)
    if isinstance(value, list):
        inner = next((k for k in get_args(kind) if k is not Ellipsis), None)
        for i, item in enumerate(value):
            _refuse_unknown(item, inner, path, f"{where}[{i}]")
    elif isinstance(value, dict) and isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        hints = get_type_hints(kind)
        for key, item in value.items():
            if key not in hints:
                nearest = difflib.get_close_matches(key, hints, n=1, cutoff=0.0)[0]
                raise ConfigError(
                    f"{path}: unknown key {f'{where}.{key}'.lstrip('.')!r}; "
                    f"the nearest is {nearest!r}"
                )
            _refuse_unknown(item, hints[key], path, f"{where}.{key}")
