"""What travels between stages: columns with unit and meaning, checked Arrow tables L1 to L6, and flag bits.

``bits`` is plain Python, so that the pure packages may use it; ``columns`` and ``levels`` import pyarrow.
"""
