"""Where a drone is: Algorithm 1 of the paper."""
