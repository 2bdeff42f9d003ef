"""Sensors and clocks held against physics and each other, before any estimator runs."""
