"""Steady driving: masks over the rows of a track, stretches between them, and the ledger of every metre."""
