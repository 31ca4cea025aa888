"""Settings of every property test; and kernels are compiled before the first of any test."""

import os

import pytest
from hypothesis import HealthCheck, settings

from vcl_companion.wire.warm_up import warm_up

# Wall time says nothing about a property on a shared machine; in CI the same examples every time.
settings.register_profile(
    "vcl",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=os.environ.get("CI") == "true",
)
settings.load_profile("vcl")


def pytest_configure(config: pytest.Config) -> None:
    """Compile, once on this machine: no test that waits for something then waits for that.

    pytest-xdist's workers begin after this, and load what is there.
    """
    if not hasattr(config, "workerinput"):
        warm_up()
