"""Roles, topics, meaning of messages, clocks and extrinsics: the content of a log as arrays."""
