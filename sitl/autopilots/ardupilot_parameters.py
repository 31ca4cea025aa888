"""The parameters of an ArduCopter that flies on our poses alone, in simulation."""

from __future__ import annotations

# Position, height and heading by vision (its documentation, "Non-GPS Position Estimation").
VISION_ALONE = {
    "AHRS_EKF_TYPE": 3.0,
    "VISO_TYPE": 1.0,
    "EK3_SRC1_POSXY": 6.0,
    "EK3_SRC1_VELXY": 0.0,
    "EK3_SRC1_POSZ": 6.0,
    "EK3_SRC1_VELZ": 0.0,
    "EK3_SRC1_YAW": 6.0,
    "GPS1_TYPE": 0.0,
}
# Builds that run an estimator for each set of sources compare them before they arm.
_ALL_SETS = {
    f"EK3_SRC{n}_{name.removeprefix('EK3_SRC1_')}": value
    for n in (2, 3)
    for name, value in VISION_ALONE.items()
    if name.startswith("EK3_SRC1_")
}
# What a calibration of the simulated sensors gives: SIM_MAG_OFS, and any small error of the two
# accelerometers, as 0 stands for one that was never calibrated.
_CALIBRATED = {
    **{f"COMPASS_OFS{n}_X": 5.0 for n in ("", 2, 3)},
    **{f"COMPASS_OFS{n}_Y": 13.0 for n in ("", 2, 3)},
    **{f"COMPASS_OFS{n}_Z": -18.0 for n in ("", 2, 3)},
    **{f"INS_ACC{n}OFFS_{axis}": 0.001 for n in ("", 2) for axis in "XYZ"},
    **{f"INS_ACC{n}SCAL_{axis}": 1.001 for n in ("", 2) for axis in "XYZ"},
}
_SIMULATED = {
    **VISION_ALONE,
    **_ALL_SETS,
    **_CALIBRATED,
    # What it hears is as late as we are quick: nothing on the way is to be made up for.
    "VISO_DELAY_MS": 0.0,
    "LOG_BACKEND_TYPE": 0.0,
    "FRAME_CLASS": 1.0,
}
RECORDED = {**_SIMULATED, "ARMING_SKIPCHK": -1.0}


def of_a_mission(speed_m_s: float) -> dict[str, float]:
    """Return those of one that flies by itself, with all of its checks before it arms."""
    return {
        **_SIMULATED,
        "FS_THR_ENABLE": 0.0,  # there is no remote control
        "GUID_OPTIONS": 64.0,  # straight to a place, and not by the shortest time
        # The same until 4.6, and since: what it does not know it passes over.
        "WPNAV_SPEED": 100.0 * speed_m_s,
        "WP_SPD": speed_m_s,
    }
