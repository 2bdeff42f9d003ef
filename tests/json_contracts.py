"""The contracts of documents and answers as JSON Schema, which ``docs/contracts.py`` makes."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

_SPEC = spec_from_file_location("contracts", Path(__file__).parents[1] / "docs" / "contracts.py")
assert _SPEC is not None
assert _SPEC.loader is not None
_CONTRACTS = module_from_spec(_SPEC)
_SPEC.loader.exec_module(_CONTRACTS)
json_output_types, make_contracts = _CONTRACTS.json_output_types, _CONTRACTS.make_contracts
