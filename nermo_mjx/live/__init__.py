"""A robot that is driven while it walks: one controller, tick by tick, for the simulated body and the real one."""
