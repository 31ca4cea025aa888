"""Which of an autopilot's parameters keep it from using our poses, or make that dangerous.

From docs/autopilots.md, seen with ArduCopter 4.7.0 and PX4 1.16.1, and from the firmwares' own
documentation of external navigation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from vcl_companion.links.origin import HEIGHT_BY_VISION, HEIGHT_REFERENCE
from vcl_companion.links.vision_pose import Firmware

Severity = Literal["prevents", "dangerous", "warns"]
_EV_HPOS, _EV_VPOS, _EV_VEL, _EV_YAW = 1, 2, 4, 8


@dataclass(frozen=True)
class Rule:
    """What one parameter has to be.

    Attributes:
        name: the parameter's; or those of older firmware, the first that there is.
        severity: ``prevents`` fusing, is ``dangerous``, or only ``warns``.
        is_right: whether a value will do.
        should_be: the value that it is set to.
        why: what is wrong with any other.
        may_lack: whether a firmware without it is right.
    """

    name: tuple[str, ...]
    severity: Severity
    is_right: Callable[[float], bool]
    should_be: float
    why: str
    may_lack: bool = False


@dataclass(frozen=True)
class Finding:
    """A parameter that is not what it has to be.

    Attributes:
        name: its own.
        value: what it is; None when the firmware has none of the name.
        should_be: what it should be.
        severity: see ``Rule``.
        why: for people.
    """

    name: str
    value: float | None
    should_be: float
    severity: Severity
    why: str


def rules_for(firmware: Firmware, *, sends_velocity: bool, sets_origin: bool) -> tuple[Rule, ...]:
    """Return the rules of a firmware; none for one that is not known.

    Args:
        firmware: whose.
        sends_velocity: whether it is sent ODOMETRY.
        sets_origin: whether it is told a global origin.
    """
    if firmware is Firmware.ARDUPILOT:
        return _ardupilot(sends_velocity=sends_velocity)
    if firmware is Firmware.PX4:
        return _px4(sends_velocity=sends_velocity, sets_origin=sets_origin)
    return ()


def names_of(rules: tuple[Rule, ...]) -> tuple[str, ...]:
    """Return every parameter that has to be read, each once."""
    return tuple(dict.fromkeys(name for rule in rules for name in rule.name))


def findings(rules: tuple[Rule, ...], values: Mapping[str, float]) -> list[Finding]:
    """Return what is not as it has to be, what is worst first.

    Args:
        rules: of the firmware.
        values: of the parameters that it has.
    """
    out = []
    for rule in rules:
        name = next((n for n in rule.name if n in values), None)
        if name is None:
            if not rule.may_lack:
                out.append(Finding(rule.name[0], None, rule.should_be, rule.severity, rule.why))
        elif not rule.is_right(values[name]):
            out.append(Finding(name, values[name], rule.should_be, rule.severity, rule.why))
    order = ("dangerous", "prevents", "warns")
    return sorted(out, key=lambda found: order.index(found.severity))


def _is(*wanted: float) -> Callable[[float], bool]:
    return lambda value: any(abs(value - one) < 1e-6 for one in wanted)


def _at_most(most: float) -> Callable[[float], bool]:
    return lambda value: value <= most + 1e-6


def _ardupilot(*, sends_velocity: bool) -> tuple[Rule, ...]:
    speeds = (0.0, 6.0) if sends_velocity else (0.0,)
    no_speed = "our poses hold no velocity: it would wait for one for ever"
    return (
        Rule(("AHRS_EKF_TYPE",), "prevents", _is(3.0), 3.0, "only EKF3 takes external navigation"),
        Rule(("EK3_ENABLE",), "prevents", _is(1.0), 1.0, "EKF3 is switched off"),
        Rule(
            ("VISO_TYPE",), "prevents", _is(1.0), 1.0,
            "1 hands our resets on; 0 hears no poses; 2 drops them for a second after a reset; 3 "
            "takes a relocalization for its own drift and hides it",
        ),
        Rule(
            ("EK3_SRC1_POSXY",), "prevents", _is(6.0), 6.0,
            "its horizontal position comes from elsewhere",
        ),
        Rule(("EK3_SRC1_VELXY",), "prevents", _is(*speeds), 0.0, no_speed),
        Rule(("EK3_SRC1_VELZ",), "prevents", _is(*speeds), 0.0, no_speed),
        Rule(
            ("EK3_SRC1_POSZ",), "warns", _is(1.0, 6.0), 6.0,
            "its height comes from elsewhere: 6 is ours, 1 the barometer's",
        ),
        Rule(
            ("EK3_SRC1_YAW",), "prevents", _is(1.0, 6.0), 6.0,
            "its heading comes from elsewhere: 6 is ours, 1 the compass's",
        ),
        Rule(
            ("VISO_ORIENT",), "dangerous", _is(0.0), 0.0,
            "our poses are the body's: it would turn them once more",
        ),
        Rule(
            ("VISO_SCALE",), "dangerous", _is(1.0), 1.0, "our poses are in metres",
        ),
        *(
            Rule(
                (f"VISO_POS_{axis}",), "dangerous", _is(0.0), 0.0,
                "our poses are the body's, not the camera's: it would shift them once more",
            )
            for axis in "XYZ"
        ),
        Rule(
            ("VISO_QUAL_MIN",), "prevents", _is(0.0), 0.0,
            "our poses tell no quality, and would all be too bad", may_lack=True,
        ),
        Rule(
            ("VISO_POS_M_NSE",), "warns", _at_most(0.05), 0.05,
            "it takes our poses for worse than they are",
        ),
        Rule(
            ("GPS1_TYPE", "GPS_TYPE"), "warns", _is(0.0), 0.0,
            "it waits for a GPS before it lets itself be armed", may_lack=True,
        ),
    )  # fmt: skip


def _px4(*, sends_velocity: bool, sets_origin: bool) -> tuple[Rule, ...]:
    def takes_position(value: float) -> bool:
        return bool(int(value) & _EV_HPOS)

    def takes_no_velocity(value: float) -> bool:
        return sends_velocity or not int(value) & _EV_VEL

    def is_safe(height_reference: float) -> bool:
        return not sets_origin or round(height_reference) != HEIGHT_BY_VISION

    used = float(_EV_HPOS | _EV_VPOS | _EV_YAW)
    return (
        Rule(
            (HEIGHT_REFERENCE,), "dangerous", is_safe, 0.0,
            "with vision (3) a global origin throws its height by that origin's altitude at the "
            "next reset, and the drone climbs away",
        ),
        *(
            Rule(
                (f"EKF2_EV_POS_{axis}",), "dangerous", _is(0.0), 0.0,
                "our poses are the body's, not the camera's: it would shift them once more",
            )
            for axis in "XYZ"
        ),
        Rule(("EKF2_EN",), "prevents", _is(1.0), 1.0, "EKF2 is switched off", may_lack=True),
        Rule(
            ("EKF2_EV_CTRL",), "prevents", takes_position, used,
            "it takes no position from our poses (3: with the compass, 11: with our heading)",
        ),
        Rule(
            ("EKF2_EV_CTRL",), "prevents", takes_no_velocity, used,
            "it waits for a velocity, which our poses do not hold",
        ),
        Rule(
            ("EKF2_EV_QMIN",), "prevents", _is(0.0), 0.0,
            "our poses tell no quality, and would all be too bad", may_lack=True,
        ),
        Rule(
            ("EKF2_GPS_CTRL",), "warns", _is(0.0), 0.0, "it takes a position from GPS as well",
        ),
        Rule(
            ("EKF2_EV_NOISE_MD",), "warns", _is(0.0), 0.0,
            "it does not look at what our poses say of their error",
        ),
        Rule(
            ("EKF2_EVP_NOISE",), "warns", _at_most(0.03), 0.01,
            "it takes our poses for worse than they are, and errs by twice as much or more",
        ),
        Rule(
            ("SYS_HAS_GPS",), "warns", _is(0.0), 0.0,
            "it waits for a GPS before it lets itself be armed", may_lack=True,
        ),
    )  # fmt: skip
