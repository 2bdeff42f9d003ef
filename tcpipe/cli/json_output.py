"""What ``--json`` prints, one dataclass a command, and the documents of the upper floors: ``schemas/`` holds a contract of each."""

from __future__ import annotations

from importlib import import_module

_ANSWERS = {
    "model": "learning.model_card.ModelCard",
    "cost-map": "planning.cost_map.CostMapCard",
    "evaluation": "learning.evaluation_facts.Evaluation",
    "path-totals": "planning.path_files.TableTotals",
    "plan": "planning.path_files.PlanFile",
    "reproduction": "experiment.reproduction.ReproductionSummary",
    "acknowledge.answer": "pipeline.problems.Acknowledged",
    "add-map.answer": "pipeline.maps.AddedMap",
    "build-dataset.answer": "pipeline.dataset.build.BuildResult",
    "cost-map.answer": "planning.cost_map.CostMapResult",
    "diff.answer": "pipeline.diff.Difference",
    "evaluate-drives.answer": "planning.drives.Drives",
    "explain.answer": "pipeline.explain.Explained",
    "export.answer": "pipeline.export.Exported",
    "export-layers.answer": "pipeline.layers.ExportedLayers",
    "ingest-log.answer": "pipeline.plan.LogLine",
    "ingest-summary.answer": "pipeline.ingest.SummaryLine",
    "inspect-dataset.answer": "pipeline.inspected.InspectedDataset",
    "inspect-log.answer": "pipeline.log_inspection.InspectedLog",
    "inspect-logs.answer": "pipeline.inspect.InspectedLogs",
    "inspect-map.answer": "pipeline.inspected.InspectedMap",
    "inspect-run.answer": "pipeline.inspect.InspectedRun",
    "inspect-store.answer": "pipeline.inspect.InspectedStore",
    "inspect-tables.answer": "pipeline.inspect.InspectedTables",
    "migrate.answer": "pipeline.migrate.Migrated",
    "overlay.answer": "pipeline.overlay.Overlay",
    "plan-path.answer": "planning.path_files.PlanResult",
    "predict-path.answer": "planning.path_files.PathResult",
    "preflight.answer": "pipeline.preflight.Preflight",
    "prune.answer": "pipeline.prune.Pruned",
    "reproduce.answer": "experiment.reproduction.Reproduction",
    "simulate.answer": "simulation.SimulatedSite",
    "status.answer": "pipeline.status.Status",
    "train.answer": "learning.training.TrainResult",
    "verify.answer": "pipeline.verify.Verified",
}
"""Where the dataclass of each contract is; of several kinds of answers one each."""


def collect_contracts() -> dict[str, str]:
    """Return file name → JSON Schema text, of all that has one."""
    from tcpipe.formats.contracts import make_contracts

    return make_contracts(json_output_types())


def json_output_types() -> dict[str, type]:
    """Return the dataclass of every such answer and document, by the name of its contract."""
    homes = {name: f"tcpipe.{path}".rpartition(".") for name, path in _ANSWERS.items()}
    return {name: getattr(import_module(module), cls) for name, (module, _, cls) in homes.items()}
