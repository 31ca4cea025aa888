"""Settings of every property test."""

import os

from hypothesis import HealthCheck, settings

# Wall time says nothing about a property on a shared machine; in CI the same examples every time.
settings.register_profile(
    "vcl",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=os.environ.get("CI") == "true",
)
settings.load_profile("vcl")
