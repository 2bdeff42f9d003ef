"""Sensor fusion: state, process, measurements, gating, filters and smoother."""
