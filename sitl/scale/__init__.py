"""How what drones say to each other grows with their number: many in one process, counted."""
