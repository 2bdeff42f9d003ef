"""Steady driving: masks over the rows of a track, sections between them, and the distance breakdown."""
