"""Maps as grids: classes, patch geometry, the sampling kernel, layers."""
