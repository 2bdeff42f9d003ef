"""The recipe: every key that rules the pipeline, with default, bounds and reason; checked when it is made, in TOML and in Python alike."""

from tcpipe.recipe.sections import (
    CovariateConfig,
    DatasetConfig,
    Extrinsics,
    FuseConfig,
    IngestSections,
    LabelConfig,
    MaskConfig,
    ReadConfig,
    Recipe,
    Role,
    SampleConfig,
    SegmentConfig,
    SplitConfig,
    TableMapping,
    TimeWindow,
    TrainConfig,
)

__all__ = [
    "CovariateConfig",
    "DatasetConfig",
    "Extrinsics",
    "FuseConfig",
    "IngestSections",
    "LabelConfig",
    "MaskConfig",
    "ReadConfig",
    "Recipe",
    "Role",
    "SampleConfig",
    "SegmentConfig",
    "SplitConfig",
    "TableMapping",
    "TimeWindow",
    "TrainConfig",
]
