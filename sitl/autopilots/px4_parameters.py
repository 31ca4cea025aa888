"""The parameters of a PX4 that flies on our poses alone, in simulation, and why each is set."""

from __future__ import annotations

from sitl.autopilots.hil_sensors import PERIOD_US
from sitl.mission import Mission

_VISION_ALONE = {
    # Position, height and heading by vision (its documentation, "Visual Inertial Odometry").
    "EKF2_EV_CTRL": 11.0,
    # No GPS, which is not missed before it arms either.
    "EKF2_GPS_CTRL": 0.0,
    "SYS_HAS_GPS": 0.0,
    # What our poses say of their error is what it is.
    "EKF2_EVP_NOISE": 0.01,
    # What it hears is as late as we are quick: nothing on the way is to be made up for.
    "EKF2_EV_DELAY": 0.0,
    # Nobody reads its log.
    "SDLOG_MODE": -1.0,
}
RECORDED = {
    **_VISION_ALONE,
    # Height is ours too: nobody tells it a global origin.
    "EKF2_HGT_REF": 3.0,
    # It takes a pose for one of the nearest end of its estimator's steps (EstimatorInterface's
    # setExtVisionData moves it by half a step, RingBuffer's pop_first_older_than does the rest).
    # A step is 10 ms by default, which comes to two readings of its sensors: frames that are whole
    # multiples of those apart are all flight long taken for 4 ms too early, too late, or for
    # right, by which reading it began with. One reading a step.
    "EKF2_PREDICT_US": float(PERIOD_US),
}


def of_a_mission(mission: Mission) -> dict[str, float]:
    """Return those of one that flies by itself, with all of its checks before it arms."""
    return {
        **_VISION_ALONE,
        # Its pilot tells it an origin, which would throw a height by vision: the barometer's.
        "EKF2_HGT_REF": 0.0,
        # No remote control, nor a joystick; so who may not fly to setpoints any more lands.
        "COM_RC_IN_MODE": 4.0,
        "COM_OBL_RC_ACT": 4.0,
        # How far it climbs when it takes off.
        "MIS_TAKEOFF_ALT": -float(mission.places()[0, 2]) if mission.legs else 0.0,
    }
