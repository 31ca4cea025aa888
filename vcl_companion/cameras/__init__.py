"""Where frames come from: a device, a simulator's stream, a recording."""
