"""One drone, one daemon: the parts of the service, put together."""
