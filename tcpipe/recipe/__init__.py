"""The recipe: every key that rules the pipeline, with default, bounds and reason; checked when it is made, in TOML and in Python alike."""

from tcpipe.recipe.sections import (
    DatasetConfig,
    FuseConfig,
    GateConfig,
    IngestSections,
    LabelConfig,
    Placement,
    ReadConfig,
    Recipe,
    Role,
    SampleConfig,
    SegmentConfig,
    SplitConfig,
)

__all__ = [
    "DatasetConfig",
    "FuseConfig",
    "GateConfig",
    "IngestSections",
    "LabelConfig",
    "Placement",
    "ReadConfig",
    "Recipe",
    "Role",
    "SampleConfig",
    "SegmentConfig",
    "SplitConfig",
]
