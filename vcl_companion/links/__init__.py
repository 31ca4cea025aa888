"""MAVLink to the autopilot and to the other drones: sockets and serial ports, codec, clocks."""
