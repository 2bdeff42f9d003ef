"""Checks of sensors and clocks against physics and each other."""
