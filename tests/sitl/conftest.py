"""What tests of flights share."""

import os

import pytest

from tests.sitl.real_firmware import ARDUPILOT, PX4, Real


@pytest.fixture(params=[ARDUPILOT, PX4], ids=lambda real: real.kind)
def real(request: pytest.FixtureRequest) -> Real:
    """A firmware that the environment names."""
    wanted: Real = request.param
    if not os.environ.get(wanted.variable):
        pytest.skip(f"{wanted.variable} names no firmware")
    return wanted
