"""The parameters of an ArduCopter that flies on our poses alone."""

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
