"""The ground station: it speaks to drones over their telemetry, and asks them for things."""
