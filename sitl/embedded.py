"""What comes with the package."""

from pathlib import Path

DEMO = Path(__file__).parent / "recordings" / "demo"
"""The demo's recording: three drones and a wall, some seconds."""
