"""Cutting a driven path into segments of one chord each."""
