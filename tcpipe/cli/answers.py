"""What ``--json`` prints, one dataclass a command, and the documents of the upper floors: ``schemas/`` holds a contract of each."""

from __future__ import annotations


def every_contract() -> dict[str, str]:
    """Return file name → JSON Schema text, of all that has one."""
    from tcpipe.formats.contracts import contracts
    from tcpipe.formats.json_files import schema_of

    return contracts() | {f"{name}.schema.json": schema_of(cls) for name, cls in answers().items()}


def answers() -> dict[str, type]:
    """Return the dataclass of every such answer and document, by the name of its contract."""
    from tcpipe.learning.model_card import ModelCard
    from tcpipe.learning.training import TrainResult
    from tcpipe.pipeline.dataset.build import BuildResult
    from tcpipe.pipeline.diff import Difference
    from tcpipe.pipeline.export import Exported
    from tcpipe.pipeline.verify import Verified
    from tcpipe.planning.cost_map import CostMapCard, CostMapResult
    from tcpipe.simulation import SimulatedSite

    return {
        "model": ModelCard,
        "cost-map": CostMapCard,
        "build-dataset.answer": BuildResult,
        "cost-map.answer": CostMapResult,
        "diff.answer": Difference,
        "export.answer": Exported,
        "simulate.answer": SimulatedSite,
        "train.answer": TrainResult,
        "verify.answer": Verified,
    }
