"""Roles, topics, message meanings, clocks and placements: what a log says, as arrays."""
