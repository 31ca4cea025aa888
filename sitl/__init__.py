"""The swarm in software: rendered or recorded flights, real daemons, stand-in autopilots."""
