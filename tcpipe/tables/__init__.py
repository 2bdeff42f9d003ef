"""Data between stages: columns with unit and meaning, checked Arrow tables L1 to L6, flags, findings and verdicts."""
