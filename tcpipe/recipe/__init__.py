"""The recipe: every key that rules the pipeline, with default, bounds and reason; checked when it is made, in TOML and in Python alike."""

from tcpipe.recipe.sections import (
    CovariateConfig,
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
    TableMapping,
)

__all__ = [
    "CovariateConfig",
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
    "TableMapping",
]
