"""What ``--json`` prints, one dataclass a command, and the documents of the upper floors: ``schemas/`` holds a contract of each."""

from __future__ import annotations


def every_contract() -> dict[str, str]:
    """Return file name → JSON Schema text, of all that has one."""
    from tcpipe.formats.contracts import contracts

    return contracts(answers())


def answers() -> dict[str, type]:
    """Return the dataclass of every such answer and document, by the name of its contract; of several kinds one each."""
    from tcpipe.learning.evaluation_facts import Evaluation
    from tcpipe.learning.model_card import ModelCard
    from tcpipe.learning.reproduction import Reproduction, ReproductionSummary
    from tcpipe.learning.training import TrainResult
    from tcpipe.pipeline.dataset.build import BuildResult
    from tcpipe.pipeline.diff import Difference
    from tcpipe.pipeline.explain import Explained
    from tcpipe.pipeline.export import Exported
    from tcpipe.pipeline.ingest import SummaryLine
    from tcpipe.pipeline.ingest_task import LogLine
    from tcpipe.pipeline.inspect import InspectedLogs, InspectedRun, InspectedStore
    from tcpipe.pipeline.inspected import InspectedDataset, InspectedMap
    from tcpipe.pipeline.layers import ExportedLayers
    from tcpipe.pipeline.log_inspection import InspectedLog
    from tcpipe.pipeline.maps import AddedMap
    from tcpipe.pipeline.migrate import Migrated
    from tcpipe.pipeline.overlay import Overlay
    from tcpipe.pipeline.preflight import Preflight
    from tcpipe.pipeline.problems import Acknowledged
    from tcpipe.pipeline.prune import Pruned
    from tcpipe.pipeline.status import Status
    from tcpipe.pipeline.table_proposal import InspectedTables
    from tcpipe.pipeline.verify import Verified
    from tcpipe.planning.cost_map import CostMapCard, CostMapResult
    from tcpipe.planning.drive_files import Drives
    from tcpipe.planning.path_files import PathResult, TableTotals
    from tcpipe.planning.plan_files import PlanFile, PlanResult
    from tcpipe.simulation import SimulatedSite

    return {
        "model": ModelCard,
        "cost-map": CostMapCard,
        "evaluation": Evaluation,
        "path-totals": TableTotals,
        "plan": PlanFile,
        "reproduction": ReproductionSummary,
        "acknowledge.answer": Acknowledged,
        "add-map.answer": AddedMap,
        "build-dataset.answer": BuildResult,
        "cost-map.answer": CostMapResult,
        "diff.answer": Difference,
        "evaluate-drives.answer": Drives,
        "explain.answer": Explained,
        "export.answer": Exported,
        "export-layers.answer": ExportedLayers,
        "ingest-log.answer": LogLine,
        "ingest-summary.answer": SummaryLine,
        "inspect-dataset.answer": InspectedDataset,
        "inspect-log.answer": InspectedLog,
        "inspect-logs.answer": InspectedLogs,
        "inspect-map.answer": InspectedMap,
        "inspect-run.answer": InspectedRun,
        "inspect-store.answer": InspectedStore,
        "inspect-tables.answer": InspectedTables,
        "migrate.answer": Migrated,
        "overlay.answer": Overlay,
        "plan-path.answer": PlanResult,
        "predict-path.answer": PathResult,
        "preflight.answer": Preflight,
        "prune.answer": Pruned,
        "reproduce.answer": Reproduction,
        "simulate.answer": SimulatedSite,
        "status.answer": Status,
        "train.answer": TrainResult,
        "verify.answer": Verified,
    }
